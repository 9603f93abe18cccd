#include "fastloop/features/orb_pattern.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <fstream>
#include <opencv2/features2d.hpp>

namespace fastloop {
namespace {

constexpr int kSize = 141, kCentre = kSize / 2, kReach = 40;

/// Descriptor bits of cv::ORB at the centre of an image, upright.
std::array<bool, 256> standard_bits(const cv::Mat& image) {
  const auto orb = cv::ORB::create(1, 1.2f, 1);
  std::vector<cv::KeyPoint> keypoints{cv::KeyPoint(kCentre, kCentre, 31, 0, 1, 0)};
  cv::Mat descriptors;
  orb->compute(image, keypoints, descriptors);
  std::array<bool, 256> bits{};
  for (int i = 0; i < 256; ++i) bits[i] = (descriptors.at<std::uint8_t>(0, i / 8) >> (i % 8)) & 1;
  return bits;
}

/// For every test the steps at which its bit is set, of images that step up (or down) at u(x, y) =
/// k.
struct StepResponse {
  std::array<int, 256> first, last;
  StepResponse() {
    first.fill(kReach + 1);
    last.fill(-kReach - 1);
  }
};

template <class Coordinate>
StepResponse sweep(Coordinate u, bool rising) {
  StepResponse response;
  for (int k = -kReach; k <= kReach; ++k) {
    cv::Mat image(kSize, kSize, CV_8U);
    for (int y = 0; y < kSize; ++y)
      for (int x = 0; x < kSize; ++x)
        image.at<std::uint8_t>(y, x) = (u(x - kCentre, y - kCentre) >= k) == rising ? 255 : 0;
    const auto bits = standard_bits(image);
    for (int i = 0; i < 256; ++i) {
      if (!bits[i]) continue;
      response.first[i] = std::min(response.first[i], k);
      response.last[i] = std::max(response.last[i], k);
    }
  }
  return response;
}

struct Interval {
  int u0 = 0, u1 = 0;  ///< coordinate of the first and the second point
  bool known = false;  ///< false when the two are equal
};

/// The two points' coordinate along u. The image is blurred before the test (7 x 7): a step at k
/// reaches the pixels k - 3 .. k + 2, so a rising bit (u0 < u1) is set for k = u0 - 2 .. u1 + 3.
template <class Coordinate>
std::array<Interval, 256> measure(Coordinate u) {
  const StepResponse rising = sweep(u, true), falling = sweep(u, false);
  std::array<Interval, 256> result;
  for (int i = 0; i < 256; ++i) {
    if (rising.first[i] <= rising.last[i])
      result[i] = {rising.first[i] + 2, rising.last[i] - 3, true};
    else if (falling.first[i] <= falling.last[i])
      result[i] = {falling.last[i] - 3, falling.first[i] + 2, true};
  }
  return result;
}

std::array<OrbTest, 256> measured_pattern() {
  const auto along_x = measure([](int x, int) { return x; });
  const auto along_y = measure([](int, int y) { return y; });
  // Where the two points share a column (or row), no step along it sets the bit. There a single
  // bright pixel beside the second point finds the shared line.
  std::array<OrbTest, 256> pattern{};
  const auto as_i8 = [](int v) { return static_cast<std::int8_t>(v); };
  for (int i = 0; i < 256; ++i) {
    Interval x = along_x[i], y = along_y[i];
    EXPECT_TRUE(x.known || y.known);
    for (int shared = -15; shared <= 15 && !(x.known && y.known); ++shared) {
      cv::Mat image(kSize, kSize, CV_8U, cv::Scalar(0));
      const bool vertical = !x.known;  // the points share x
      const Interval& other = vertical ? y : x;
      const int bright = kCentre + other.u1, line = kCentre + shared;
      image.at<std::uint8_t>(vertical ? bright : line, vertical ? line : bright) = 255;
      const bool reached = standard_bits(image)[i];
      if (!reached) continue;
      // The blur reaches three pixels to either side: the first hit is three before the line.
      (vertical ? x : y) = {shared + 3, shared + 3, true};
    }
    EXPECT_TRUE(x.known && y.known);
    pattern[i] = {as_i8(x.u0), as_i8(y.u0), as_i8(x.u1), as_i8(y.u1)};
  }
  return pattern;
}

TEST(OrbPattern, EqualsWhatOpenCvComputes) {
  const auto measured = measured_pattern();
  if (const char* path = std::getenv("FASTLOOP_WRITE_ORB_PATTERN")) {
    std::ofstream out(path);
    out << "// x0, y0, x1, y1 of the 256 tests; see orb_pattern.hpp for where they come from.\n";
    for (int i = 0; i < 256; ++i) {
      const OrbTest& t = measured[i];
      out << "{" << int(t.x0) << ", " << int(t.y0) << ", " << int(t.x1) << ", " << int(t.y1) << "},"
          << (i % 5 == 4 || i == 255 ? '\n' : ' ');
    }
    ASSERT_TRUE(out.good());
  }
  for (int i = 0; i < 256; ++i) EXPECT_EQ(measured[i], kOrbPattern[i]) << "test " << i;
}

TEST(OrbPattern, StaysWithinThePatch) {
  for (const OrbTest& t : kOrbPattern) {
    EXPECT_LE(t.x0 * t.x0 + t.y0 * t.y0, 18.4 * 18.4);
    EXPECT_LE(t.x1 * t.x1 + t.y1 * t.y1, 18.4 * 18.4);
  }
}

}  // namespace
}  // namespace fastloop
