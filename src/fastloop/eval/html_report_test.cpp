#include "fastloop/eval/html_report.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

#include "fastloop/core/error.hpp"
#include "fastloop/eval/html.hpp"
#include "fastloop/eval/svg.hpp"

namespace fastloop::eval {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

constexpr Nanoseconds kStart = 1'000'000'000'000;

/// A run around a circle whose live poses drift until a loop at 15 s.
ReportInput example() {
  ReportInput input;
  RunFolder& run = input.run;
  io::Trajectory truth;
  Json t = Json::array(), ms = Json::array();
  for (int i = 0; i < 200; ++i) {
    const Nanoseconds stamp = kStart + i * 100'000'000LL;
    const Vector3d p(3 * std::cos(0.05 * i), 2 * std::sin(0.05 * i), 0);
    truth.poses.push_back({stamp, SE3(Eigen::Quaterniond::Identity(), p)});
    run.final_poses.push_back({stamp, SE3(Eigen::Quaterniond::Identity(), 1.01 * p)});
    run.live_poses.push_back(
        {stamp, SE3(Eigen::Quaterniond::Identity(), p + Vector3d(0, i < 150 ? 0.01 * i : 0, 0))});
    t.push_back(0.1 * i);
    ms.push_back(20 + i % 7);
  }
  input.ground_truth = truth;
  input.ground_truth_name = "truth <1>.csv";
  run.summary =
      Json::parse(R"({"version":"1","dataset":"a & b","mode":"stereo","seconds":19.9,"frames":200,
    "tracked_percent":99.5,"keyframes":17,"landmarks":4321,"loops_closed":1,"maps_merged":0})");
  run.timing = Json::parse(
      R"({"stages":{"orb":{"count":200,"mean_ms":10.123456,"p50_ms":10,"p95_ms":11,"p99_ms":12,
    "max_ms":13}},"fps":31.25,"memory":{"peak_mib":321.5,"samples":[
    {"t_s":0,"wall_s":0,"resident_mib":100,"keyframes":1,"landmarks":9},
    {"t_s":19,"wall_s":7,"resident_mib":321.5,"keyframes":17,"landmarks":99}]},
    "machine":{"cpu":"a CPU","cores":2,"memory_gib":23.5,"compiler":"c","build":"Release","commit":"abc"}})");
  run.timing["first_stamp_ns"] = kStart;
  run.timing["track_by_frame"] = {{"t_s", t}, {"ms", ms}};
  run.events = {{kStart + 15'000'000'000, "loop_closed", "4 keyframes moved"}};
  run.loops = {{kStart + 15'000'000'000,
                12,
                true,
                false,
                "",
                4,
                5,
                6,
                {{"words", 1.5}, {"loop_fusion", 2.5}, {"graph_solve", 3.25}}}};
  return input;
}

TEST(HtmlReport, TellsTheRunWithTheNumbersOfItsFiles) {
  const ReportInput input = example();
  const std::string page = html_report(input);
  EXPECT_THAT(page, HasSubstr("fastloop: a &amp; b"));
  EXPECT_THAT(page, HasSubstr("truth &lt;1&gt;.csv"));
  EXPECT_THAT(page,
              HasSubstr("data-key=\"timing.stages.orb.mean_ms\" data-value=\"10.123456\">10.12<"));
  EXPECT_THAT(page, HasSubstr("data-key=\"summary.landmarks\" data-value=\"4321\">4321<"));
  EXPECT_THAT(page, HasSubstr("data-key=\"loops.0.total\" data-value=\"7.25\">7.25<"));
  const Json evaluation = evaluation_json(input);
  const double final_ate = evaluation["final"]["ate_m"]["rmse"],
               live_ate = evaluation["live"]["ate_m"]["rmse"];
  EXPECT_GT(live_ate, final_ate);
  EXPECT_THAT(page, HasSubstr("data-key=\"evaluation.final.ate_m.rmse\" data-value=\"" +
                              evaluation["final"]["ate_m"]["rmse"].dump()));
  EXPECT_THAT(page, HasSubstr("loop closed</text>"));
  EXPECT_THAT(page, Not(HasSubstr("nan")));
}

TEST(HtmlReport, FetchesNothing) {
  const std::string page = html_report(example());
  for (const char* word : {"<script", "src=", "url(", "@import", "<iframe"})
    EXPECT_THAT(page, Not(HasSubstr(word)));
  EXPECT_THAT(page, HasSubstr("name=\"viewport\""));
}

TEST(HtmlReport, RunsWithoutTruthLoopsOrPoses) {
  ReportInput input = example();
  input.ground_truth.reset();
  input.run.loops.clear();
  EXPECT_THAT(html_report(input), HasSubstr("No loop was closed"));
  EXPECT_TRUE(evaluation_json(input)["final"].is_null());
  input.run.final_poses.clear();
  input.run.live_poses.clear();
  input.run.timing["track_by_frame"] = {{"t_s", Json::array()}, {"ms", Json::array()}};
  const std::string page = html_report(input);
  EXPECT_THAT(page, Not(HasSubstr("Seen from above")));
  EXPECT_THAT(page, HasSubstr("Stage times"));
}

TEST(HtmlReport, ResultsThatAreNoneAreRefused) {
  ReportInput input = example();
  input.benches = {Json::parse(R"({"kind":"bench loops"})")};
  EXPECT_THROW(html_report(input), InvalidArgument);
}

TEST(Chart, LogarithmicAxesAreStraightForPowers) {
  Chart chart;
  chart.x_log = chart.y_log = true;
  chart.series = {{"s", "#000", {{10, 1}, {100, 10}, {1000, 100}}, {}, 1.5, true}};
  const std::string svg = draw_chart(chart);
  EXPECT_THAT(svg, HasSubstr(">100<"));
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  const Axes axes{0, 0, 100, 100, 1, 100, 1, 100, true, true};
  EXPECT_NEAR(axes.x(10), 50, 1e-9);
  EXPECT_NEAR(axes.y(10), 50, 1e-9);
  EXPECT_NEAR(axes.y(1), 100, 1e-9);
}

TEST(Chart, NothingToDrawIsNoPicture) {
  EXPECT_EQ(draw_chart({}), "");
  Chart flat;
  flat.series = {{"s", "#000", {{1, 5}, {1, 5}}, {}}};
  EXPECT_THAT(draw_chart(flat), Not(HasSubstr("nan")));
  flat.equal = true;
  EXPECT_THAT(draw_chart(flat), Not(HasSubstr("nan")));
}

}  // namespace
}  // namespace fastloop::eval
