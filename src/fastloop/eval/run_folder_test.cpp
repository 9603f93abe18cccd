#include "fastloop/eval/run_folder.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/io/test_support.hpp"

namespace fastloop::eval {
namespace {

using ::testing::HasSubstr;

constexpr const char* kLoop =
    R"({"t":"105.000000000","keyframe":9,"verdict":"accepted","reason":"loop closed","candidates":[],)"
    R"("correction":{"kind":"loop","applied":true,"keyframes_moved":4,"landmarks_joined":5,"observations_added":6},)"
    R"("backend":"cpu","times_ms":{"words":1.0,"loop_fusion":9.0,"apply_poses":2.0}})";

/// A run of ten seconds at one frame a second, with a loop at five.
void write_run(const io::TemporaryFolder& folder, const std::string& loops, double close_ms = 10) {
  Json timing{{"stages", {{"loop_close", {{"count", 1}, {"mean_ms", close_ms}}}}},
              {"first_stamp_ns", 100'000'000'000},
              {"track_by_frame", {{"t_s", Json::array()}, {"ms", Json::array()}}}};
  for (int i = 0; i < 10; ++i) {
    timing["track_by_frame"]["t_s"].push_back(i);
    timing["track_by_frame"]["ms"].push_back(10 * i);
  }
  folder.write("summary.json", R"({"frames": 10})");
  folder.write("timing.json", timing.dump());
  folder.write("events.jsonl", R"({"t":"100.000000000","event":"initialised","reason":"stereo"})"
                               "\n");
  folder.write("loops.jsonl", loops);
  folder.write("trajectory_body.txt", "100.0 0 0 0 0 0 0 1\n101.0 1 0 0 0 0 0 1\n");
  folder.write("trajectory_live.txt", "");
}

TEST(RunFolder, ReadsBackWhatARunWrote) {
  const io::TemporaryFolder folder;
  write_run(
      folder,
      std::string(kLoop) + "\n" +
          R"({"t":"106.000000000","keyframe":10,"verdict":"rejected","reason":"no","candidates":[]})");
  const RunFolder run = read_run_folder(folder.path());
  ASSERT_EQ(run.loops.size(), 1u);
  EXPECT_EQ(run.refused_candidates, 1u);
  EXPECT_EQ(run.loops[0].stamp_ns, 105'000'000'000);
  EXPECT_EQ(run.loops[0].keyframes_moved, 4u);
  EXPECT_EQ(run.applied(false).size(), 1u);
  EXPECT_EQ(run.applied(true).size(), 0u);
  EXPECT_DOUBLE_EQ(paper_times(run.loops[0].stages_ms).total(), 12);
  EXPECT_EQ(run.events[0].kind, "initialised");
  EXPECT_EQ(run.final_poses.size(), 2u);
  EXPECT_TRUE(run.live_poses.empty());
  EXPECT_THAT(run.tracking_around_loops_ms(), ::testing::ElementsAre(30, 40, 50, 60, 70));
}

TEST(RunFolder, StageSumsAreCompared) {
  const io::TemporaryFolder folder;
  write_run(folder, kLoop, 10.1);
  EXPECT_EQ(check_stage_sums(read_run_folder(folder.path())), std::nullopt);
  write_run(folder, kLoop, 12);
  EXPECT_TRUE(check_stage_sums(read_run_folder(folder.path())));
  write_run(folder, "", 12);
  EXPECT_EQ(check_stage_sums(read_run_folder(folder.path())), std::nullopt);
}

TEST(RunFolder, SaysWhatCannotBeRead) {
  const io::TemporaryFolder folder;
  const auto message = [&]() -> std::string {
    try {
      read_run_folder(folder.path());
    } catch (const InputError& e) {
      return e.what();
    }
    return "";
  };
  EXPECT_THAT(message(), HasSubstr("summary.json"));
  write_run(folder, R"({"t": 3, "correction": {}})");
  EXPECT_THAT(message(), HasSubstr("loops.jsonl:1"));
  write_run(folder, kLoop);
  folder.write("timing.json", "{");
  EXPECT_THAT(message(), HasSubstr("timing.json"));
}

}  // namespace
}  // namespace fastloop::eval
