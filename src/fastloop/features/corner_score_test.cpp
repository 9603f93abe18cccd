#include "fastloop/features/corner_score.hpp"

#include <gtest/gtest.h>

#include <opencv2/features2d.hpp>
#include <set>

#include "fastloop/features/cv_view.hpp"
#include "fastloop/features/scene_for_tests.hpp"

namespace fastloop {
namespace {

TEST(CornerScore, EqualsTheDefinitionAtEveryPixel) {
  for (const auto& [width, height] :
       {std::pair{200, 90}, {38, 20}, {37, 20}, {71, 7}, {12, 30}, {5, 5}}) {
    const ImageU8 image = synthetic_scene::textured_image(width, height, 3);
    ImageU8 scores;
    corner_scores(image, 7, scores);
    ASSERT_EQ(scores.width, width);
    for (int y = 0; y < height; ++y)
      for (int x = 0; x < width; ++x) {
        int expected = 0;
        if (x >= 3 && y >= 3 && x < width - 3 && y < height - 3)
          expected = reference::corner_score(image, x, y);
        if (expected <= 7) expected = 0;
        ASSERT_EQ(scores.at(x, y), expected) << width << "x" << height << " at " << x << ", " << y;
      }
  }
}

TEST(CornerScore, MarksTheCornersOfOpenCv) {
  const ImageU8 image = synthetic_scene::textured_image(300, 200, 4);
  for (const int threshold : {7, 20, 60}) {
    std::vector<cv::KeyPoint> keypoints;
    cv::FAST(as_mat(image), keypoints, threshold, false);
    std::set<std::pair<int, int>> expected, ours;
    for (const cv::KeyPoint& k : keypoints) expected.insert({cvRound(k.pt.x), cvRound(k.pt.y)});
    ImageU8 scores;
    corner_scores(image, threshold, scores);
    for (int y = 0; y < 200; ++y)
      for (int x = 0; x < 300; ++x)
        if (scores.at(x, y) > 0) ours.insert({x, y});
    EXPECT_EQ(ours, expected);
  }
}

TEST(CornerScore, PeaksAreLocalMaximaAndTiesKeepOne) {
  for (const auto& [width, height] : {std::pair{150, 60}, {41, 60}, {20, 20}}) {
    ImageU8 scores(width, height);
    std::mt19937 rng(9);
    for (auto& s : scores.pixels)
      s = static_cast<std::uint8_t>(rng() % 4 == 0 ? rng() % 6 : 0);  // many ties
    std::vector<ScorePeak> peaks;
    score_peaks(scores, 4, peaks);
    std::set<std::pair<int, int>> found, expected;
    for (const ScorePeak& p : peaks) {
      EXPECT_EQ(p.score, scores.at(p.x, p.y));
      EXPECT_TRUE(found.insert({p.y, p.x}).second) << "a peak reported twice";
    }
    for (int y = 4; y < height - 4; ++y)
      for (int x = 4; x < width - 4; ++x) {
        bool peak = scores.at(x, y) > 0;
        for (int v = -1; v <= 1; ++v)
          for (int u = -1; u <= 1; ++u) {
            const int other = scores.at(x + u, y + v);
            const bool before = v < 0 || (v == 0 && u < 0);
            peak = peak && (before ? scores.at(x, y) > other : scores.at(x, y) >= other);
          }
        if (peak) expected.insert({y, x});
      }
    EXPECT_EQ(found, expected);
  }
}

}  // namespace
}  // namespace fastloop
