// Inertial initialisation on the recorded IMU of EuRoC V1_01 with poses of its ground truth, from
// the folder FASTLOOP_DATA; skipped where it is absent.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "fastloop/optimization/inertial_init.hpp"

namespace fastloop::optimization {
namespace {

/// Without the variable: the folder shared/data beside the source tree that this file belongs to.
std::filesystem::path sequence() {
  const char* variable = std::getenv("FASTLOOP_DATA");
  const std::filesystem::path source_tree =
      std::filesystem::path(__FILE__).parent_path() / "../../..";
  return (variable ? std::filesystem::path(variable) : source_tree / "../shared/data") /
         "euroc_v101_sparse";
}

std::vector<std::vector<double>> read_numbers(const std::filesystem::path& file) {
  std::vector<std::vector<double>> rows;
  std::ifstream in(file);
  for (std::string line; std::getline(in, line);) {
    if (line.empty() || line[0] == '#') continue;
    for (char& c : line)
      if (c == ',') c = ' ';
    std::istringstream numbers(line);
    std::vector<double>& row = rows.emplace_back();
    for (std::string word; numbers >> word;) row.push_back(std::stod(word));
  }
  return rows;
}

struct Recording {
  std::vector<ImuSample> imu;
  std::vector<Nanoseconds> stamps_ns;
  std::vector<SE3> T_world_body;
};

Recording read_recording() {
  Recording r;
  // Stamps relative to this one keep their nanoseconds in a double.
  const double origin_s = 1403715270.0;
  for (const auto& row : read_numbers(sequence() / "mav0/imu0/data.csv")) {
    if (row.size() < 7) continue;
    r.imu.push_back({static_cast<Nanoseconds>(row[0] - origin_s * 1e9),
                     {row[1], row[2], row[3]},
                     {row[4], row[5], row[6]}});
  }
  for (const auto& row : read_numbers(sequence() / "V1_01_easy_openvins_corrected_tum.txt")) {
    if (row.size() < 8) continue;
    r.stamps_ns.push_back(from_seconds(row[0] - origin_s));
    r.T_world_body.emplace_back(Eigen::Quaterniond(row[7], row[4], row[5], row[6]),
                                Vector3d(row[1], row[2], row[3]));
  }
  return r;
}

/// Keyframes `stride` poses apart, in a world turned by `visual`.
InertialInitProblem window(const Recording& r, std::size_t begin, int keyframes, int stride,
                           const SE3& visual) {
  InertialInitProblem p;
  for (int i = 0; i < keyframes; ++i) {
    const std::size_t k = begin + i * stride;
    p.T_world_body.push_back(visual * r.T_world_body[k]);
    if (i + 1 == keyframes) break;
    const auto before = [](const ImuSample& s, Nanoseconds t) { return s.stamp_ns < t; };
    const Nanoseconds from = r.stamps_ns[k], to = r.stamps_ns[k + stride];
    auto first = std::lower_bound(r.imu.begin(), r.imu.end(), from, before);
    auto last = std::lower_bound(r.imu.begin(), r.imu.end(), to, before);
    if (first != r.imu.begin()) --first;
    if (last != r.imu.end()) ++last;
    p.between.push_back(std::make_shared<PreintegratedImu>(std::span(first, last), from, to,
                                                           ImuBias{}, ImuCalibration{}));
  }
  return p;
}

TEST(InertialInitOnEuRoC, FindsGravityAndBiasInEveryWindow) {
  if (!std::filesystem::exists(sequence())) GTEST_SKIP() << "no data in " << sequence();
  const Recording r = read_recording();
  ASSERT_GT(r.T_world_body.size(), 2000u);
  const SE3 visual(so3::exp({1.2, -0.7, 0.4}), Vector3d(3, -2, 1));
  const Vector3d truth = visual.rotation * kGravityWorld;
  // The bias of this IMU hardly moves in two minutes: that of the whole flight is the reference.
  const InertialInitResult whole = initialize_inertial(window(r, 200, 100, 20, visual));
  ASSERT_TRUE(whole.success) << whole.reason;
  std::vector<double> errors;
  for (std::size_t begin = 200; begin + 100 < r.T_world_body.size(); begin += 100) {
    const InertialInitResult result = initialize_inertial(window(r, begin, 20, 5, visual));
    if (!result.success && result.reason == "too little motion") continue;
    ASSERT_TRUE(result.success) << result.reason;
    const Vector3d g = result.R_world_gravity * kGravityWorld;
    errors.push_back(std::atan2(truth.cross(g).norm(), truth.dot(g)) * 180 / M_PI);
    EXPECT_LT((result.bias.gyro - whole.bias.gyro).norm(), 0.01);
    EXPECT_LT((result.bias.accel - whole.bias.accel).norm(), 0.3);
    RecordProperty("gravity_error_deg_" + std::to_string(begin), std::to_string(errors.back()));
  }
  ASSERT_GT(errors.size(), 15u);
  std::sort(errors.begin(), errors.end());
  EXPECT_LT(errors[errors.size() / 2], 0.5);
  EXPECT_LT(errors.back(), 2.0);
}

}  // namespace
}  // namespace fastloop::optimization
