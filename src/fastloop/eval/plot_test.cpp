#include "fastloop/eval/plot.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "fastloop/core/error.hpp"

namespace fastloop::eval {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;

/// A circle in the plane of two axes, with a gap in time.
Evaluation circle(int first_axis, int second_axis) {
  std::vector<io::StampedPose> reference, estimate;
  for (int i = 0; i < 200; ++i) {
    Vector3d p = Vector3d::Zero();
    p[first_axis] = 3 * std::cos(0.05 * i);
    p[second_axis] = 2 * std::sin(0.05 * i);
    reference.push_back({i * 50'000'000LL, SE3(Eigen::Quaterniond::Identity(), p)});
    if (i < 80 || i > 120)
      estimate.push_back({i * 50'000'000LL, SE3(Eigen::Quaterniond::Identity(), 1.1 * p)});
  }
  return evaluate(reference, estimate, {AlignmentKind::kSe3, 1.0});
}

int count(const std::string& text, const std::string& word) {
  int n = 0;
  for (auto at = text.find(word); at != std::string::npos; at = text.find(word, at + 1)) ++n;
  return n;
}

TEST(Svg, BreaksLinesAtGapsAndNamesTheAxes) {
  const std::string svg = to_svg(circle(0, 1), "a <title> & more");
  EXPECT_EQ(count(svg, "<polyline"), 6);  // ground truth, estimate and error, two pieces each
  EXPECT_THAT(svg, HasSubstr(">x [m]<"));
  EXPECT_THAT(svg, HasSubstr(">y [m]<"));
  EXPECT_THAT(svg, HasSubstr("a &lt;title&gt; &amp; more"));
  EXPECT_THAT(svg, HasSubstr("RPE over 1.00 s"));
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
}

TEST(Svg, LooksAlongTheAxisOfLeastMotion) {
  EXPECT_THAT(to_svg(circle(0, 2), ""), Not(HasSubstr(">y [m]<")));
  EXPECT_THAT(to_svg(circle(1, 2), ""), Not(HasSubstr(">x [m]<")));
}

TEST(Svg, SurvivesAnEstimateWithoutErrorOrMotion) {
  const std::vector<io::StampedPose> still{{0, SE3()}, {1'000'000'000, SE3()}};
  const std::string svg = to_svg(evaluate(still, still, {AlignmentKind::kNone, {}}), "still");
  EXPECT_THAT(svg, Not(HasSubstr("nan")));
  EXPECT_THAT(svg, Not(HasSubstr("inf")));
}

TEST(Svg, WritingReportsWhatFails) {
  EXPECT_THROW(write_svg("/nonexistent/folder/plot.svg", circle(0, 1), ""), InputError);
  EXPECT_THROW(to_svg(Evaluation{}, ""), InvalidArgument);
}

}  // namespace
}  // namespace fastloop::eval
