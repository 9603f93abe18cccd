#include "fastloop/features/orb_extractor.hpp"

#include <gtest/gtest.h>
#include <tbb/global_control.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <numeric>
#include <opencv2/features2d.hpp>
#include <opencv2/imgproc.hpp>
#include <random>
#include <set>

#include "fastloop/core/error.hpp"
#include "fastloop/features/blur.hpp"
#include "fastloop/features/corner_detection.hpp"
#include "fastloop/features/cv_view.hpp"
#include "fastloop/features/hamming.hpp"
#include "fastloop/features/orb_descriptor.hpp"
#include "fastloop/features/scene_for_tests.hpp"

namespace fastloop {
namespace {

using synthetic_scene::textured_image;

double occupied_share(const OrbFeatures& f, int width, int height) {
  std::set<int> cells;
  for (std::size_t i = 0; i < f.size(); ++i)
    cells.insert(static_cast<int>(f.y[i] * 6 / height) * 8 + static_cast<int>(f.x[i] * 8 / width));
  return static_cast<double>(cells.size()) / 48;
}

TEST(OrbExtractor, GivesTheNumberAskedForSpreadOverImageAndLevels) {
  const ImageU8 image = textured_image(752, 480, 1);
  OrbExtractor extractor;
  const OrbFeatures f = extractor.extract(image);
  EXPECT_EQ(f.size(), 1200u);
  EXPECT_EQ(occupied_share(f, 752, 480), 1.0);
  std::vector<int> per_level(8, 0);
  for (std::size_t i = 0; i < f.size(); ++i) {
    ++per_level[f.octave[i]];
    EXPECT_GE(f.x[i], 18);
    EXPECT_LE(f.x[i], 752 - 18);
    EXPECT_GE(f.y[i], 18);
    EXPECT_LE(f.y[i], 480 - 18);
    EXPECT_GE(f.angle_rad[i], 0);
    EXPECT_LT(f.angle_rad[i], 2 * M_PI);
  }
  for (int l = 1; l < 8; ++l) {
    EXPECT_LE(per_level[l], per_level[l - 1]);
    EXPECT_NEAR(static_cast<double>(per_level[l]) / per_level[l - 1], 1 / 1.2, 0.05);
  }
}

TEST(OrbExtractor, IsTheSameForAnyNumberOfThreadsAndAnyHistory) {
  const ImageU8 image = textured_image(640, 480, 2), other = textured_image(320, 200, 3);
  OrbExtractor fresh, used;
  used.extract(other);
  const OrbFeatures a = used.extract(image);
  tbb::global_control one_thread(tbb::global_control::max_allowed_parallelism, 1);
  const OrbFeatures b = fresh.extract(image);
  EXPECT_EQ(a.x, b.x);
  EXPECT_EQ(a.y, b.y);
  EXPECT_EQ(a.angle_rad, b.angle_rad);
  EXPECT_EQ(a.octave, b.octave);
  EXPECT_EQ(a.descriptors, b.descriptors);
}

TEST(OrbExtractor, MeetsFlatTinyAndEmptyImages) {
  OrbExtractor extractor;
  EXPECT_THROW(extractor.extract(ImageU8{}), InvalidArgument);
  for (const auto& [width, height] :
       {std::pair{1, 1}, {7, 7}, {39, 39}, {40, 60}, {640, 1}, {64, 48}}) {
    ImageU8 flat(width, height);
    std::fill(flat.pixels.begin(), flat.pixels.end(), std::uint8_t{90});
    EXPECT_EQ(extractor.extract(flat).size(), 0u) << width << "x" << height;
    const OrbFeatures f = extractor.extract(textured_image(width, height, 5));
    for (std::size_t i = 0; i < f.size(); ++i) {
      EXPECT_LT(f.x[i], width);
      EXPECT_LT(f.y[i], height);
    }
  }
  // Few corners: all of them are kept, the count is what there is.
  ImageU8 spot(200, 200);
  spot.at(100, 100) = 255;
  EXPECT_GE(extractor.extract(spot).size(), 1u);
}

TEST(OrbExtractor, RefusesImpossibleOptions) {
  const auto rejected = [](auto change) {
    OrbOptions o;
    change(o);
    EXPECT_THROW(OrbExtractor{o}, InvalidArgument);
  };
  rejected([](OrbOptions& o) { o.num_features = 0; });
  rejected([](OrbOptions& o) { o.num_features = 70000; });
  rejected([](OrbOptions& o) { o.levels = 0; });
  rejected([](OrbOptions& o) { o.scale_factor = 1; });
  rejected([](OrbOptions& o) { o.fast_min_threshold = 30; });
}

TEST(OrbDescriptor, EqualsOpenCvOnTheSameKeypoints) {
  const ImageU8 image = textured_image(400, 300, 7);
  ImageU8 blurred(400, 300);
  blur_for_description(image, blurred);
  const auto orb = cv::ORB::create(600, 1.2f, 1);
  std::vector<cv::KeyPoint> keypoints;
  cv::Mat descriptors;
  orb->detectAndCompute(as_mat(image), cv::noArray(), keypoints, descriptors);
  ASSERT_GT(keypoints.size(), 300u);
  int different_bits = 0;
  for (std::size_t k = 0; k < keypoints.size(); ++k) {
    const int x = cvRound(keypoints[k].pt.x), y = cvRound(keypoints[k].pt.y);
    const PatchDirection d = patch_direction(image, x, y);
    const double error =
        std::remainder(std::atan2(d.sin, d.cos) - keypoints[k].angle * M_PI / 180, 2 * M_PI);
    EXPECT_LT(std::abs(error), 0.01);  // OpenCV's arc tangent is good to 0.3 degrees
    const float angle = keypoints[k].angle * static_cast<float>(M_PI / 180);
    const Descriptor ours = describe(blurred, x, y, {std::cos(angle), std::sin(angle)});
    Descriptor theirs;
    std::memcpy(&theirs, descriptors.ptr(static_cast<int>(k)), sizeof theirs);
    different_bits += hamming_distance(ours, theirs);
  }
  EXPECT_LT(different_bits, 0.005 * 256 * static_cast<double>(keypoints.size()));
}

/// Share of the features of `image`, moved by `warp`, that have a feature of `warped` within 2
/// pixels (at their scale) whose descriptor is the nearest of all.
double share_found_again(const ImageU8& image, const cv::Matx23d& warp, int width, int height) {
  ImageU8 warped(width, height);
  cv::Mat target = as_mat(warped);
  cv::warpAffine(as_mat(image), target, warp, target.size(), cv::INTER_LINEAR,
                 cv::BORDER_REFLECT_101);
  OrbExtractor extractor;
  const OrbFeatures a = extractor.extract(image), b = extractor.extract(warped);
  const PyramidScales scales;
  int found = 0, visible = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    const cv::Vec2d p = warp * cv::Vec3d(a.x[i], a.y[i], 1);
    if (p[0] < 80 || p[1] < 80 || p[0] > width - 80 || p[1] > height - 80) continue;
    ++visible;
    const NearestDescriptor best = nearest_descriptor(a.descriptors[i], b.descriptors);
    const double distance = std::hypot(b.x[best.position] - p[0], b.y[best.position] - p[1]);
    found += best.distance < 64 && distance < 2 * scales.scale[a.octave[i]];
  }
  return static_cast<double>(found) / visible;
}

TEST(OrbExtractor, FindsFeaturesAgainAfterRotationAndScaling) {
  const ImageU8 image = textured_image(640, 640, 11);
  const auto about_centre = [](double degrees, double scale) {
    const cv::Mat m = cv::getRotationMatrix2D(cv::Point2f(319.5f, 319.5f), degrees, scale);
    return cv::Matx23d(m.ptr<double>());
  };
  EXPECT_GT(share_found_again(image, about_centre(90, 1), 640, 640), 0.75);
  EXPECT_GT(share_found_again(image, about_centre(30, 1), 640, 640), 0.5);
  EXPECT_GT(share_found_again(image, about_centre(0, 1 / 1.2), 640, 640), 0.5);
}

TEST(OrbExtractor, LevelPixelsMapToWhatTheyShow) {
  // A bright disc: its centre, measured on any level, must come out at the same base pixel.
  ImageU8 image(300, 200);
  cv::Mat mat = as_mat(image);
  cv::circle(mat, cv::Point(150, 90), 40, cv::Scalar(200), cv::FILLED, cv::LINE_AA);
  OrbExtractor extractor;
  extractor.extract(image);
  for (int l = 0; l < 8; ++l) {
    const cv::Moments m = cv::moments(as_mat(extractor.pyramid().levels[l]));
    const LevelScale scale(extractor.pyramid(), l);
    const float x = static_cast<float>(m.m10 / m.m00), y = static_cast<float>(m.m01 / m.m00);
    EXPECT_NEAR(scale.to_base_x(x), 150, 0.15) << "level " << l;
    EXPECT_NEAR(scale.to_base_y(y), 90, 0.15) << "level " << l;
    EXPECT_NEAR(scale.to_level_x(scale.to_base_x(x)), x, 1e-3);
  }
}

TEST(CornerDetection, UsesTheLowThresholdOnlyWhereTheHighOneFindsNothing) {
  ImageU8 image(280, 140);
  std::fill(image.pixels.begin(), image.pixels.end(), std::uint8_t{100});
  const auto square = [&](int x, int y, int size, int grey) {
    cv::Mat mat = as_mat(image);
    cv::rectangle(mat, cv::Rect(x, y, size, size), cv::Scalar(grey), cv::FILLED);
  };
  // Cells are 40 x 51 pixels here, from (19, 19).
  square(64, 24, 9, 200);   // strong
  square(80, 50, 9, 118);   // weak, in the same cell: not wanted
  square(200, 60, 9, 118);  // weak, alone: wanted
  cv::Mat blurred = as_mat(image);
  cv::GaussianBlur(blurred, blurred, cv::Size(3, 3), 0.6);
  std::vector<Corner> corners;
  ImageU8 scores;
  detect_corners(image, 19, 20, 7, scores, corners);
  int strong = 0, weak_alone = 0;
  for (const Corner& c : corners) {
    strong += c.x < 100 && c.score >= 20;
    weak_alone += c.x > 150 && c.score >= 7 && c.score < 20;
    EXPECT_FALSE(c.x > 76 && c.x < 93 && c.y > 46 && c.y < 63);
  }
  EXPECT_GE(strong, 4);
  EXPECT_GE(weak_alone, 4);
}

TEST(CornerDetection, SharesFeaturesAmongLevels) {
  const std::vector<int> plenty(8, 100000);
  const std::vector<int> share = share_among_levels(1200, 1.2f, plenty);
  EXPECT_EQ(std::accumulate(share.begin(), share.end(), 0), 1200);
  EXPECT_NEAR(share[0], 1200 * (1 - 1 / 1.2) / (1 - std::pow(1.2, -8)), 1);
  // What a level lacks, others give.
  const std::vector<int> lacking{1000, 5, 1000, 0};
  const std::vector<int> shifted = share_among_levels(600, 1.2f, lacking);
  EXPECT_EQ(shifted[1], 5);
  EXPECT_EQ(shifted[3], 0);
  EXPECT_EQ(shifted[0] + shifted[2], 595);
  EXPECT_EQ(share_among_levels(600, 1.2f, std::vector<int>{3, 4}), (std::vector<int>{3, 4}));
  EXPECT_EQ(share_among_levels(600, 1.2f, std::vector<int>{0, 0}), (std::vector<int>{0, 0}));
}

TEST(CornerDetection, SpreadKeepsTheStrongestOfEachPlace) {
  std::mt19937 rng(3);
  std::vector<Corner> corners;
  for (int i = 0; i < 5000; ++i) {
    // Most corners crowd into one corner of the image.
    const bool crowd = i % 10 != 0;
    corners.push_back({static_cast<std::int16_t>(rng() % (crowd ? 150 : 600)),
                       static_cast<std::int16_t>(rng() % (crowd ? 100 : 400)),
                       static_cast<std::int16_t>(7 + rng() % 100)});
  }
  const std::vector<Corner> chosen = spread_evenly(corners, 200, 600, 400);
  EXPECT_EQ(chosen.size(), 200u);
  std::set<int> cells;
  int crowded = 0;
  for (const Corner& c : chosen) {
    cells.insert(c.x / 75 + c.y / 67 * 8);
    crowded += c.x < 150 && c.y < 100;
  }
  EXPECT_GE(cells.size(), 44u);
  EXPECT_LT(crowded, 40);
}

}  // namespace
}  // namespace fastloop
