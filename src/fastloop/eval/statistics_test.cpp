#include "fastloop/eval/statistics.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>

#include "fastloop/core/error.hpp"

namespace fastloop::eval {
namespace {

using ::testing::HasSubstr;

TEST(SampleStatistics, KnownValues) {
  const SampleStatistics s = describe({4, 2, 9, 5});
  EXPECT_EQ(s.count, 4u);
  EXPECT_DOUBLE_EQ(s.mean, 5);
  EXPECT_DOUBLE_EQ(s.median, 4.5);
  EXPECT_DOUBLE_EQ(s.sd, std::sqrt(26.0 / 3));
  EXPECT_DOUBLE_EQ(s.min, 2);
  EXPECT_DOUBLE_EQ(s.max, 9);
  EXPECT_DOUBLE_EQ(s.spread(), 7);
  EXPECT_DOUBLE_EQ(describe({3, 1, 2}).median, 2);
}

TEST(SampleStatistics, OneNoneAndNotFinite) {
  EXPECT_EQ(describe({}).count, 0u);
  EXPECT_DOUBLE_EQ(describe({7}).mean, 7);
  EXPECT_DOUBLE_EQ(describe({7}).sd, 0);
  EXPECT_THROW(describe({1, std::numeric_limits<double>::quiet_NaN()}), InvalidArgument);
}

TEST(SampleStatistics, MovesAndScalesWithTheMeasurements) {
  std::mt19937 random(3);
  std::normal_distribution<double> normal;
  std::vector<double> values, moved;
  for (int i = 0; i < 101; ++i) values.push_back(normal(random));
  for (const double v : values) moved.push_back(10 - 3 * v);
  const SampleStatistics a = describe(values), b = describe(moved);
  EXPECT_NEAR(b.mean, 10 - 3 * a.mean, 1e-12);
  EXPECT_NEAR(b.median, 10 - 3 * a.median, 1e-12);
  EXPECT_NEAR(b.sd, 3 * a.sd, 1e-12);
  EXPECT_NEAR(b.spread(), 3 * a.spread(), 1e-12);
}

/// A timing source whose truth is known: two stages that vary from run to run, the first runs slow.
class SyntheticSource {
 public:
  SyntheticSource(double first_ms, double second_ms, int slow_runs)
      : first_ms_(first_ms), second_ms_(second_ms), slow_runs_(slow_runs) {}
  TimedStages operator()() {
    const double slow = run_ < slow_runs_ ? 100 : 1;
    const double wobble = (run_ - slow_runs_) % 5 - 2;  // -2 .. 2
    ++run_;
    const double a = slow * (first_ms_ + wobble), b = slow * second_ms_;
    return {{{"first", a}, {"second", b}}, a + b};
  }
  int runs() const { return run_; }

 private:
  double first_ms_, second_ms_;
  int slow_runs_, run_ = 0;
};

std::vector<double> totals(const std::vector<TimedStages>& runs) {
  std::vector<double> t;
  for (const TimedStages& r : runs) t.push_back(r.total_ms);
  return t;
}

TEST(MeasureInTurn, DropsTheWarmUpAndFindsTheTruth) {
  SyntheticSource slow(40, 60, 1), fast(10, 10, 1);
  const std::vector<TimedSource> sources{std::ref(slow), std::ref(fast)};
  const auto measured = measure_in_turn(sources, 1, 5);
  ASSERT_EQ(measured.size(), 2u);
  EXPECT_EQ(slow.runs(), 6);
  EXPECT_EQ(fast.runs(), 6);
  const SampleStatistics a = describe(totals(measured[0])), b = describe(totals(measured[1]));
  EXPECT_EQ(a.count, 5u);
  EXPECT_DOUBLE_EQ(a.mean, 100);
  EXPECT_DOUBLE_EQ(a.median, 100);
  EXPECT_DOUBLE_EQ(a.sd, std::sqrt(2.5));
  EXPECT_DOUBLE_EQ(a.spread(), 4);
  EXPECT_DOUBLE_EQ(a.mean / b.mean, 5);
  // Without the warm-up dropped the mean would be another one.
  SyntheticSource again(40, 60, 1);
  const std::vector<TimedSource> one{std::ref(again)};
  EXPECT_GT(describe(totals(measure_in_turn(one, 0, 5)[0])).mean, 1000);
}

TEST(MeasureInTurn, TakesTurns) {
  std::string order;
  const std::vector<TimedSource> sources{[&] { return order += 'a', TimedStages{}; },
                                         [&] { return order += 'b', TimedStages{}; }};
  measure_in_turn(sources, 1, 2);
  EXPECT_EQ(order, "ababab");
  EXPECT_THROW(measure_in_turn(sources, 0, 0), InvalidArgument);
  EXPECT_THROW(measure_in_turn(sources, -1, 1), InvalidArgument);
}

TEST(SumMismatch, HoldsWithinTwoPercent) {
  SyntheticSource source(40, 60, 0);
  const TimedStages run = source();
  EXPECT_EQ(sum_mismatch(run.stages_ms, run.total_ms), std::nullopt);
  EXPECT_EQ(sum_mismatch(run.stages_ms, run.total_ms * 1.019), std::nullopt);
  const auto unmeasured = sum_mismatch(run.stages_ms, run.total_ms * 1.03);
  ASSERT_TRUE(unmeasured);
  EXPECT_THAT(*unmeasured, HasSubstr("allowed 2.0 %"));
  EXPECT_TRUE(sum_mismatch(run.stages_ms, run.total_ms * 0.97));
  EXPECT_EQ(sum_mismatch({{"tiny", 0.01}}, 0.05), std::nullopt);
  EXPECT_TRUE(sum_mismatch({}, 1));
}

TEST(Slope, OfALineWithNoiseThatCancels) {
  EXPECT_DOUBLE_EQ(slope(std::vector<double>{0, 1, 2, 3}, std::vector<double>{1, 3, 5, 7}), 2);
  EXPECT_DOUBLE_EQ(slope(std::vector<double>{-1, 0, 1}, std::vector<double>{1, -2, 1}), 0);
  EXPECT_DOUBLE_EQ(slope(std::vector<double>{2, 2}, std::vector<double>{1, 5}), 0);
  EXPECT_DOUBLE_EQ(slope({}, {}), 0);
  EXPECT_THROW(slope(std::vector<double>{1}, {}), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::eval
