#include "fastloop/eval/loop_table.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <sstream>

namespace fastloop::eval {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

/// Runs whose loops take `total_ms`, a quarter for each column, and one more for each run.
std::vector<RunMeasurement> runs_of(double total_ms, double ate_m, int loops = 1) {
  std::vector<RunMeasurement> runs;
  for (int i = 0; i < 3; ++i) {
    RunMeasurement m;
    const double q = (total_ms + i - 1) / 4;
    for (int l = 0; l < loops; ++l) m.loops.push_back({q, q, q, q, 7, {}});
    m.tracking_around_loops_ms = {10, 20, 30};
    m.tracking.count = 100;
    m.ate_m = ate_m;
    m.coverage = 1;
    m.path_length_m = 50;
    m.peak_mib = 500 + i;
    m.frames = 100;
    m.keyframes = 20;
    runs.push_back(m);
  }
  return runs;
}

SequenceResult row(const std::string& name, std::vector<std::vector<RunMeasurement>> runs) {
  SequenceResult r;
  r.row.name = name;
  r.row.group = "g";
  r.kind = SequenceKind::kHalfReal;
  r.data = name;
  r.ground_truth = "truth.csv";
  r.runs = std::move(runs);
  return r;
}

BenchInfo info(std::vector<std::string> backends) {
  BenchInfo i;
  i.command = "fastloop bench loops";
  i.date = "a day";
  i.machine.cpu = "a CPU";
  i.runs = 3;
  i.warm_up = 1;
  i.backends = std::move(backends);
  return i;
}

TEST(LoopTable, MeansSpeedUpsAndTheRestOfARow) {
  const Json table = loop_table_json(info({"reference", "cpu"}),
                                     {row("A", {runs_of(100, 0.010), runs_of(20, 0.0115)})});
  const Json& a = table["sequences"][0];
  const Json& cpu = a["backends"]["cpu"];
  EXPECT_DOUBLE_EQ(cpu["columns_ms"]["total"]["mean"], 20);
  EXPECT_DOUBLE_EQ(cpu["columns_ms"]["total"]["sd"], 1);
  EXPECT_DOUBLE_EQ(cpu["columns_ms"]["loop_correction"]["mean"], 15);
  EXPECT_DOUBLE_EQ(cpu["columns_ms"]["not_published"]["mean"], 7);
  EXPECT_DOUBLE_EQ(a["comparison"]["cpu"]["speed_up"]["total"], 5);
  EXPECT_TRUE(a["comparison"]["cpu"]["accuracy_kept"]);  // 1.5 mm
  EXPECT_TRUE(a["comparison"]["cpu"]["same_loops"]);
  EXPECT_TRUE(cpu["same_every_run"]);
  EXPECT_DOUBLE_EQ(cpu["tracking_around_loops_ms"]["worst"], 30);
  EXPECT_EQ(cpu["tracking_around_loops_ms"]["frames"], 9);
  EXPECT_DOUBLE_EQ(cpu["host_peak_mib"]["max"], 502);
  EXPECT_TRUE(cpu["device_peak_mib"].is_null());
}

TEST(LoopTable, MemoryAndTransfersOfADevice) {
  auto with = runs_of(20, 0.01);
  for (std::size_t i = 0; i < with.size(); ++i) {
    with[i].device_peak_mib = 64.0 + static_cast<double>(i);
    with[i].device_transfers_mib = 7;
  }
  const auto table_of = [&] {
    return loop_table_json(info({"reference", "cuda"}), {row("A", {runs_of(100, 0.01), with})});
  };
  const Json table = table_of();
  EXPECT_DOUBLE_EQ(table["sequences"][0]["backends"]["cuda"]["device_peak_mib"]["max"], 66);
  EXPECT_DOUBLE_EQ(table["sequences"][0]["backends"]["cuda"]["device_transfers_mib"]["max"], 7);
  EXPECT_NE(loop_table_markdown(table).find("| 66 MiB | 7 MiB |"), std::string::npos);
  with[1].device_peak_mib.reset();  // the device was lost in one run: no figure, not a wrong one
  EXPECT_TRUE(table_of()["sequences"][0]["backends"]["cuda"]["device_peak_mib"].is_null());
}

TEST(LoopTable, AccuracyIsKeptWithinFivePercentOrTwoMillimetres) {
  const auto kept = [](double reference, double other) {
    const Json table = loop_table_json(info({"reference", "cpu"}),
                                       {row("A", {runs_of(9, reference), runs_of(9, other)})});
    return table["sequences"][0]["comparison"]["cpu"]["accuracy_kept"].get<bool>();
  };
  EXPECT_TRUE(kept(0.010, 0.0119));
  EXPECT_FALSE(kept(0.010, 0.0121));
  EXPECT_TRUE(kept(1.0, 1.049));
  EXPECT_FALSE(kept(1.0, 1.051));
  EXPECT_TRUE(kept(1.0, 0.2));
}

TEST(LoopTable, AThirdBackEndIsOneMoreEntryEverywhere) {
  const auto results = std::vector<SequenceResult>{
      row("A", {runs_of(100, 0.01), runs_of(20, 0.01), runs_of(10, 0.01)})};
  const Json table = loop_table_json(info({"reference", "cpu", "third"}), results);
  EXPECT_DOUBLE_EQ(table["sequences"][0]["comparison"]["third"]["speed_up"]["total"], 10);
  const std::string markdown = loop_table_markdown(table), csv = loop_table_csv(table);
  EXPECT_THAT(markdown, HasSubstr("ATE third"));
  EXPECT_THAT(markdown, HasSubstr("kept by third"));
  EXPECT_THAT(markdown, HasSubstr("10.0 ± 1.0 (10.0x)"));
  EXPECT_THAT(csv, HasSubstr("A,g,half-real,third,3,"));
}

TEST(LoopTable, RowsWithoutLoopsTruthOrData) {
  SequenceResult no_loops = row("B", {runs_of(9, 0, 0), runs_of(9, 0, 0)});
  no_loops.ground_truth.clear();
  no_loops.warnings = {"stages do not sum"};
  SequenceResult missing;
  missing.row.name = "C";
  missing.missing = "no folder";
  const Json table = loop_table_json(info({"reference", "cpu"}), {no_loops, missing});
  const std::string markdown = loop_table_markdown(table);
  EXPECT_TRUE(table["sequences"][0]["backends"]["cpu"]["columns_ms"].is_null());
  EXPECT_THAT(markdown, HasSubstr("| B | half-real | cpu | 0 | - |"));
  EXPECT_THAT(markdown, HasSubstr("Not at hand, so without a row: C."));
  EXPECT_THAT(markdown, HasSubstr("B: stages do not sum"));
  EXPECT_THAT(markdown, HasSubstr("accuracy kept on 0 of 0"));
  EXPECT_THAT(markdown, Not(HasSubstr("nan")));
}

TEST(LoopTable, RunsThatDifferAreTold) {
  auto runs = runs_of(10, 0.01);
  runs[2].ate_m = 0.02;
  const Json table = loop_table_json(info({"cpu"}), {row("A", {runs})});
  EXPECT_FALSE(table["sequences"][0]["backends"]["cpu"]["same_every_run"]);
  EXPECT_DOUBLE_EQ(table["sequences"][0]["backends"]["cpu"]["ate_m"]["median"], 0.01);
}

TEST(LoopTable, CsvIsRectangular) {
  const Json table = loop_table_json(info({"reference", "cpu"}),
                                     {row("A", {runs_of(100, 0.01), runs_of(20, 0.01)}),
                                      row("B", {runs_of(9, 0, 0), runs_of(9, 0, 0)})});
  std::istringstream lines(loop_table_csv(table));
  std::string line;
  std::getline(lines, line);
  const auto commas = std::count(line.begin(), line.end(), ',');
  int rows = 0;
  for (; std::getline(lines, line); ++rows)
    EXPECT_EQ(std::count(line.begin(), line.end(), ','), commas) << line;
  EXPECT_EQ(rows, 4);
}

}  // namespace
}  // namespace fastloop::eval
