// A small fixed evaluation: simulated sequences, deterministic, compared with figures that are kept in a file. Says
// when accuracy or the number of loops changes, for better or worse.
#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>

#include "fastloop/io/run_output.hpp"
#include "fastloop/io/text.hpp"
#include "fastloop/io/yaml_node.hpp"
#include "simulated_run.hpp"

namespace fastloop::tests {
namespace {

struct Figures {
  double ate_m = 0, tracked_percent = 0;
  int keyframes = 0, loops = 0, merges = 0;
};

struct Bounds {
  double ate_relative = 0, ate_m = 0, tracked_percent = 0, keyframes_relative = 0;
};

struct Sequence {
  std::string name;
  sim::SequenceOptions options;
  Figures expected;
};

io::YamlNode figures_file() { return io::YamlNode::load(FASTLOOP_REFERENCE_FIGURES); }

Bounds read_bounds(const io::YamlNode& root) {
  const io::YamlNode b = root.required("bounds", "a map");
  const auto number = [&](const char* key) { return b.required(key, "a number").positive_number(); };
  return {number("ate_relative"), number("ate_m"), number("tracked_percent"), number("keyframes_relative")};
}

Sequence read_sequence(const io::YamlNode& root, const std::string& name) {
  for (const io::YamlNode& node : root.required("sequences", "a list").items()) {
    if (node.required("name", "a word").text() != name) continue;
    Sequence s;
    s.name = name;
    s.options.world = sim::parse_world_kind(node.required("world", "a world").text());
    s.options.camera = sim::parse_camera_kind(node.required("camera", "a camera").text());
    s.options.seconds = node.required("seconds", "a number").positive_number();
    s.options.rig = small_rig(s.options.camera);
    s.expected = {node.required("ate_m", "a number").number(), node.required("tracked_percent", "a number").number(),
                  node.required("keyframes", "a number").integer(), node.required("loops", "a number").integer(),
                  node.required("merges", "a number").integer()};
    return s;
  }
  throw InvalidArgument("no figures for " + name);
}

Figures run(const Sequence& s) {
  const sim::SimulatedSequence recording(s.options);
  system::System system(recording.calibration(), small_options());
  // One frame at a time: a minute of images would take a gigabyte.
  for (std::size_t i = 0; i < recording.size(); ++i) system.process(recording.frame(i));
  system.finish();
  const io::RunSummary summary = io::summarize_run(system);
  return {ate_m(system, recording), 100.0 * static_cast<double>(summary.tracked) / static_cast<double>(summary.frames),
          static_cast<int>(summary.keyframes), static_cast<int>(summary.loops), static_cast<int>(summary.merges)};
}

void expect_figures(const std::string& name) {
  const io::YamlNode root = figures_file();
  const Bounds bounds = read_bounds(root);
  const Sequence s = read_sequence(root, name);
  const Figures& e = s.expected;
  const Figures f = run(s);
  std::printf("%s: ate_m: %.4f, tracked_percent: %.1f, keyframes: %d, loops: %d, merges: %d\n", name.c_str(), f.ate_m,
              f.tracked_percent, f.keyframes, f.loops, f.merges);
  const char* advice = "worse: mend it; better: new figures and the reason go to eval/reference_figures.yaml";
  EXPECT_NEAR(f.ate_m, e.ate_m, std::max(bounds.ate_relative * e.ate_m, bounds.ate_m)) << advice;
  EXPECT_NEAR(f.tracked_percent, e.tracked_percent, bounds.tracked_percent) << advice;
  EXPECT_NEAR(f.keyframes, e.keyframes, bounds.keyframes_relative * e.keyframes) << advice;
  EXPECT_EQ(f.loops, e.loops) << advice;
  EXPECT_EQ(f.merges, e.merges) << advice;
}

TEST(ReferenceEvaluation, Room) { expect_figures("room"); }
TEST(ReferenceEvaluation, CorridorWithALoop) { expect_figures("corridor"); }
TEST(ReferenceEvaluation, RingWithALoop) { expect_figures("ring"); }

TEST(ReferenceEvaluation, FiguresSayWhenAndWhyTheyChanged) {
  const auto history = figures_file().required("history", "a list").items();
  ASSERT_FALSE(history.empty());
  std::string later = "9999";
  for (const io::YamlNode& entry : history) {
    const std::string date = entry.required("date", "a day").text();
    EXPECT_LE(date, later) << "the newest comes first";
    EXPECT_FALSE(io::trimmed(entry.required("why", "a reason").text()).empty());
    later = date;
  }
}

}  // namespace
}  // namespace fastloop::tests
