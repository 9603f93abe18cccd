#include "fastloop/features/feature_set.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "fastloop/core/error.hpp"

namespace fastloop {
namespace {

TEST(PyramidScales, ArePowersOfTheFactor) {
  const PyramidScales s(8, 1.2f);
  ASSERT_EQ(s.scale.size(), 8u);
  for (int i = 0; i < 8; ++i) {
    EXPECT_NEAR(s.scale[i], std::pow(1.2, i), 1e-5);
    EXPECT_NEAR(s.sigma2[i], std::pow(1.2, 2 * i), 1e-4);
  }
  EXPECT_THROW(PyramidScales(0, 1.2f), InvalidArgument);
  EXPECT_THROW(PyramidScales(8, 1.0f), InvalidArgument);
}

TEST(KeypointGrid, HoldsEveryKeypointOnceInItsCellInAscendingOrder) {
  std::mt19937 rng(4);
  const int width = 752, height = 480;
  std::uniform_real_distribution<float> ux(-5, width + 5), uy(-5, height + 5);
  std::vector<float> x(3000), y(3000);
  for (std::size_t i = 0; i < x.size(); ++i) x[i] = ux(rng), y[i] = uy(rng);
  KeypointGrid grid;
  grid.build(x, y, width, height);
  ASSERT_EQ(grid.start.size(),
            static_cast<std::size_t>(KeypointGrid::kCols * KeypointGrid::kRows + 1));
  EXPECT_EQ(grid.start.front(), 0u);
  EXPECT_EQ(grid.start.back(), x.size());

  std::vector<int> seen(x.size(), 0);
  for (int cy = 0; cy < KeypointGrid::kRows; ++cy)
    for (int cx = 0; cx < KeypointGrid::kCols; ++cx) {
      const int cell = cy * KeypointGrid::kCols + cx;
      for (auto k = grid.start[cell]; k < grid.start[cell + 1]; ++k) {
        const auto i = grid.indices[k];
        ++seen[i];
        if (k > grid.start[cell]) {
          EXPECT_LT(grid.indices[k - 1], i);
        }
        const float px = std::clamp(x[i], 0.f, width - 1e-3f),
                    py = std::clamp(y[i], 0.f, height - 1e-3f);
        EXPECT_GE(px, cx * grid.cell_width_px - 1e-3);
        EXPECT_LE(px, (cx + 1) * grid.cell_width_px + 1e-3);
        EXPECT_GE(py, cy * grid.cell_height_px - 1e-3);
        EXPECT_LE(py, (cy + 1) * grid.cell_height_px + 1e-3);
      }
    }
  for (const int s : seen) EXPECT_EQ(s, 1);
}

TEST(KeypointGrid, IsEmptyWithoutKeypointsAndRefusesTooMany) {
  KeypointGrid grid;
  grid.build({}, {}, 10, 10);
  EXPECT_EQ(grid.start.back(), 0u);
  EXPECT_TRUE(grid.indices.empty());
  const std::vector<float> many(65536, 1.f);
  EXPECT_THROW(grid.build(many, many, 10, 10), InvalidArgument);
  EXPECT_THROW(grid.build(many, {}, 10, 10), InvalidArgument);
  EXPECT_THROW(grid.build({}, {}, 0, 10), InvalidArgument);
}

}  // namespace
}  // namespace fastloop
