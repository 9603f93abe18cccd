#include "fastloop/eval/loop_stages.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

namespace fastloop::eval {
namespace {

using ::testing::ElementsAre;

const StageList kLoop{{"words", 1},
                      {"query", 2},
                      {"descriptor_matching", 4},
                      {"similarity", 8},
                      {"projection_searches", 16},
                      {"correct_poses", 32},
                      {"loop_fusion", 64},
                      {"connections", 128},
                      {"graph_build", 256},
                      {"graph_solve", 512},
                      {"graph_finish", 1024},
                      {"landmarks", 2048},
                      {"apply_check", 4096},
                      {"recheck", 8192}};

TEST(LoopStages, EveryStageIsInOneColumn) {
  const PaperTimes t = paper_times(kLoop);
  EXPECT_DOUBLE_EQ(t.region_detection, 1 + 2 + 4 + 8 + 16 + 8192);
  EXPECT_DOUBLE_EQ(t.loop_fusion, 64);
  EXPECT_DOUBLE_EQ(t.graph_optimisation, 256 + 512);
  EXPECT_DOUBLE_EQ(t.loop_correction(), 32 + 64 + 128 + 256 + 512 + 2048 + 4096);
  EXPECT_DOUBLE_EQ(t.not_published, 1024);
  double all = 0;
  for (const auto& [stage, ms] : kLoop) all += ms;
  EXPECT_DOUBLE_EQ(t.total() + t.not_published, all);
  EXPECT_TRUE(t.unknown.empty());
}

TEST(LoopStages, AStageNobodyKnowsIsNamed) {
  const PaperTimes t = paper_times({{"words", 1}, {"teleport", 5}});
  EXPECT_THAT(t.unknown, ElementsAre("teleport"));
  EXPECT_DOUBLE_EQ(t.total(), 1);
}

TEST(LoopStages, ColumnsOfThePaper) {
  std::vector<std::string> keys;
  for (const PaperColumn& c : paper_columns()) keys.push_back(c.key);
  EXPECT_THAT(keys, ElementsAre("total", "region_detection", "loop_fusion", "graph_optimisation",
                                "loop_correction"));
  const PaperTimes t = paper_times(kLoop);
  EXPECT_DOUBLE_EQ(paper_columns()[0].value(t),
                   paper_columns()[1].value(t) + paper_columns()[4].value(t));
}

}  // namespace
}  // namespace fastloop::eval
