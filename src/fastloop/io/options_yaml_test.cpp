#include "fastloop/io/options_yaml.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"

namespace fastloop::io {
namespace {

std::string complaint(const std::string& text) {
  system::SystemOptions options;
  try {
    parse_options(text, "o.yaml", options);
  } catch (const InputError& e) {
    return e.what();
  }
  return "";
}

TEST(OptionsYaml, OverridesOnlyWhatIsGiven) {
  system::SystemOptions options;
  const auto before = options;
  parse_options(
      "system:\n  mapping_delay_frames: 9\norb:\n  num_features: 800\ntracking:\n  "
      "keyframe_match_ratio: 0.5\nmapping:\n  "
      "window_keyframes: 7\n",
      "o.yaml", options);
  EXPECT_EQ(options.mapping_delay_frames, 9u);
  EXPECT_EQ(options.orb.num_features, 800);
  EXPECT_EQ(options.tracking.keyframe_match_ratio, 0.5);
  EXPECT_EQ(options.mapping.window_keyframes, 7u);
  EXPECT_EQ(options.orb.levels, before.orb.levels);
  EXPECT_EQ(options.tracking.min_inliers, before.tracking.min_inliers);
}

TEST(OptionsYaml, SaysWhatIsWrongAndWhere) {
  using testing::AllOf;
  using testing::HasSubstr;
  EXPECT_THAT(complaint("tracking:\n  min_inlier: 3\n"),
              AllOf(HasSubstr("o.yaml:2"), HasSubstr("min_inlier"), HasSubstr("min_inliers")));
  EXPECT_THAT(complaint("system:\n  mapping_delay_frames: 0\n"), HasSubstr("mapping_delay_frames"));
  EXPECT_THAT(complaint("slam: {}\n"), HasSubstr("slam"));
  EXPECT_THAT(complaint("orb:\n  num_features: many\n"), HasSubstr("o.yaml:2"));
  EXPECT_THAT(complaint("mapping:\n  threads: -1\n"), HasSubstr("threads"));
  EXPECT_THAT(complaint("mapping:\n  fusion_neighbours: -1\n"), HasSubstr("fusion_neighbours"));
  EXPECT_EQ(complaint("mapping:\n  threads: 2\n"), "");
}

}  // namespace
}  // namespace fastloop::io
