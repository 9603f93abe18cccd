#include "fastloop/eval/replay_table.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"
#include "fastloop/sim/map_worlds.hpp"

namespace fastloop::eval {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::Not;

/// A case with made-up times: reference `ratio` times as slow.
ReplayCase made_up(std::size_t poses, double ratio) {
  ReplayCase c;
  c.name = std::to_string(poses);
  c.keyframes = c.poses = poses;
  c.edges = 7 * poses;
  c.verdict = "accepted";
  for (const double factor : {ratio, 1.0})
    c.runs.push_back({{{{"words", factor},
                        {"loop_fusion", 2 * factor},
                        {"graph_solve", 3 * factor},
                        {"apply_poses", 4 * factor}},
                       10 * factor}});
  return c;
}

BenchInfo info() {
  BenchInfo i;
  i.backends = {"reference", "cpu"};
  i.runs = 1;
  return i;
}

TEST(ReplayTable, SpeedUpsAndCharts) {
  const Json table = replay_table_json(info(), "bench scale", {made_up(100, 4), made_up(1000, 8)});
  EXPECT_DOUBLE_EQ(table["cases"][1]["speed_up"]["cpu"]["total"], 8);
  EXPECT_DOUBLE_EQ(table["cases"][0]["backends"]["cpu"]["columns_ms"]["loop_correction"]["mean"],
                   9);
  EXPECT_THAT(replay_table_markdown(table),
              AllOf(HasSubstr("10.0 ± 0.0 (8.00x)"), Not(HasSubstr("nan"))));
  EXPECT_THAT(replay_table_csv(table),
              HasSubstr("1000,1000,0,1000,7000,cpu,stage loop_fusion,1,2.0,"));
  const std::string svg = speed_up_svg(table);
  EXPECT_THAT(svg, AllOf(HasSubstr("poses of the graph"), HasSubstr("edges of the graph"),
                         HasSubstr("graph optimisation"), Not(HasSubstr("nan"))));
  EXPECT_THAT(time_chart(table), HasSubstr("reference"));
}

TEST(ReplayTable, ABackEndThatWasLeftOutLeavesAGap) {
  ReplayCase big = made_up(100000, 1);
  big.runs[0].clear();
  big.notes = {"reference left out"};
  const Json table = replay_table_json(info(), "bench scale", {made_up(100, 4), big});
  EXPECT_TRUE(table["cases"][1]["backends"]["reference"].is_null());
  EXPECT_FALSE(table["cases"][1]["speed_up"].contains("cpu"));
  EXPECT_THAT(replay_table_markdown(table), HasSubstr("reference left out"));
  EXPECT_THAT(replay_table_csv(table), Not(HasSubstr("100000,0,100000,700000,reference")));
}

TEST(ReplayTable, RealReplaysHaveOnlyKnownStagesThatSum) {
  sim::MapWorldOptions options;
  options.keyframes = 150;
  options.features = 600;
  const sim::SimulatedMap world = sim::simulate_map(options);
  loop::LoopRequest request;
  request.keyframe = world.current;
  ReplayPlan plan;
  plan.backends = {loop::Backend::kReference, loop::Backend::kCpu};
  plan.left_out = {false, false};
  plan.runs = 3;
  const ReplayCase c = measure_replay("simulated", world.map.publish(), request, plan);
  EXPECT_EQ(c.verdict, "accepted");
  EXPECT_TRUE(c.decisions_equal);
  EXPECT_EQ(c.poses, 150u);
  EXPECT_GT(c.edges, c.poses);
  ASSERT_EQ(c.runs.size(), 2u);
  for (const auto& runs : c.runs) {
    ASSERT_EQ(runs.size(), 3u);
    for (const TimedStages& run : runs) {
      EXPECT_TRUE(paper_times(run.stages_ms).unknown.empty());
      EXPECT_LE(paper_times(run.stages_ms).total(), run.total_ms);
    }
  }
  plan.left_out = {true, false};
  plan.runs = 1;
  EXPECT_TRUE(measure_replay("one", world.map.publish(), request, plan).runs[0].empty());
  plan.left_out = {true};
  EXPECT_THROW(measure_replay("bad", world.map.publish(), request, plan), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::eval
