// Stereo matching on recorded images from the folder FASTLOOP_DATA; skipped where it is absent.
#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <opencv2/core/utility.hpp>
#include <opencv2/imgcodecs.hpp>
#include <sstream>

#include "fastloop/features/cv_view.hpp"
#include "fastloop/features/frame_builder.hpp"
#include "fastloop/features/hamming.hpp"
#include "fastloop/features/rectification.hpp"

namespace fastloop {
namespace {

namespace fs = std::filesystem;

fs::path data_folder(const char* name) {
  const char* variable = std::getenv("FASTLOOP_DATA");
  return fs::path(variable ? variable : FASTLOOP_DEFAULT_DATA) / name;
}

SE3 from_rows(std::initializer_list<double> rows) {
  Eigen::Matrix4d m = Eigen::Matrix4d::Identity();
  int k = 0;
  for (const double v : rows) m(k / 4, k % 4) = v, ++k;
  return SE3::from_matrix(m);
}

/// EuRoC, mav0/cam0 and cam1 sensor.yaml.
Calibration euroc() {
  Calibration c;
  c.cameras.push_back(
      {{CameraModel::kPinhole,
        752,
        480,
        458.654,
        457.296,
        367.215,
        248.375,
        {-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0}},
       from_rows({0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
                  0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
                  -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949}),
       20});
  c.cameras.push_back(
      {{CameraModel::kPinhole,
        752,
        480,
        457.587,
        456.134,
        379.999,
        255.238,
        {-0.28368365, 0.07451284, -0.00010473, -3.555907e-05, 0}},
       from_rows({0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556,
                  0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024,
                  -0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038}),
       20});
  return c;
}

/// TUM-VI at 512 x 512, camchain.yaml.
Calibration tum_vi() {
  Calibration c;
  c.cameras.push_back({{CameraModel::kKannalaBrandt,
                        512,
                        512,
                        190.40521435680378,
                        190.40597089713538,
                        254.89732652420363,
                        256.9152315269253,
                        {0.010171079892421483, -0.010816440029919381, 0.005942781769412756,
                         -0.001662284667857643, 0}},
                       from_rows({-0.9995378259923383, 0.02917807204183088, -0.008530798463872679,
                                  0.047094247958417004, 0.007526588843243184, -0.03435493139706542,
                                  -0.9993813532126198, -0.04788273017221637, -0.029453096117288798,
                                  -0.9989836729399656, 0.034119442089241274, -0.0697294754693238})
                           .inverse(),
                       20});
  c.cameras.push_back({{CameraModel::kKannalaBrandt,
                        512,
                        512,
                        189.6434942131518,
                        189.63291871107262,
                        252.53333516187035,
                        254.89204808827034,
                        {0.01371679169245271, -0.015567360615942622, 0.00905043103315326,
                         -0.002347858896562788, 0}},
                       from_rows({-0.9995240747493029, 0.02986739485347808, -0.007717688852024281,
                                  -0.05374086123613335, 0.008095979457928231, 0.01256553460985914,
                                  -0.9998882749870535, -0.04648588412432889, -0.02976708103202316,
                                  -0.9994748851595197, -0.0128013601698453, -0.07333210787623645})
                           .inverse(),
                       20});
  return c;
}

ImageU8 load(const fs::path& path) {
  const cv::Mat mat = cv::imread(path.string(), cv::IMREAD_GRAYSCALE);
  ImageU8 image(mat.cols, mat.rows);
  mat.copyTo(as_mat(image));
  return image;
}

/// Pairs whose files have the same name in cam0 and cam1, by time.
struct Recording {
  std::vector<std::int64_t> stamps;
  std::vector<fs::path> left;
  explicit Recording(const fs::path& mav0) {
    for (const auto& entry : fs::directory_iterator(mav0 / "cam0" / "data"))
      if (fs::exists(mav0 / "cam1" / "data" / entry.path().filename()))
        left.push_back(entry.path());
    std::sort(left.begin(), left.end());
    for (const auto& p : left) stamps.push_back(std::stoll(p.stem().string()));
  }
  FrameInput frame(std::size_t i) const {
    FrameInput input;
    input.stamp_ns = stamps[i];
    input.left = load(left[i]);
    input.right = load(left[i].parent_path().parent_path().parent_path() / "cam1" / "data" /
                       left[i].filename());
    return input;
  }
};

/// Poses by stamp from rows "stamp px py pz qw qx qy qz" separated by commas or blanks.
std::vector<std::pair<std::int64_t, SE3>> read_poses(const fs::path& path) {
  std::vector<std::pair<std::int64_t, SE3>> poses;
  std::ifstream in(path);
  for (std::string line; std::getline(in, line);) {
    if (line.empty() || line[0] == '#') continue;
    std::replace(line.begin(), line.end(), ',', ' ');
    std::istringstream row(line);
    std::string stamp;
    double v[7];
    row >> stamp;
    for (double& x : v) row >> x;
    if (row)
      poses.emplace_back(std::stoll(stamp),
                         SE3(Eigen::Quaterniond(v[3], v[4], v[5], v[6]), {v[0], v[1], v[2]}));
  }
  return poses;
}

/// Pose interpolated between recorded ones at most 0.1 s apart.
std::optional<SE3> pose_at(const std::vector<std::pair<std::int64_t, SE3>>& poses,
                           std::int64_t stamp) {
  const auto after = std::lower_bound(poses.begin(), poses.end(), stamp,
                                      [](const auto& p, std::int64_t t) { return p.first < t; });
  if (after == poses.begin() || after == poses.end()) return std::nullopt;
  const auto before = after - 1;
  if (after->first - before->first > 100'000'000) return std::nullopt;
  const double u = static_cast<double>(stamp - before->first) /
                   static_cast<double>(after->first - before->first);
  return before->second.retract(u * before->second.local(after->second));
}

double median(std::vector<double> v) {
  if (v.empty()) return std::numeric_limits<double>::quiet_NaN();
  std::nth_element(v.begin(), v.begin() + v.size() / 2, v.end());
  return v[v.size() / 2];
}

/// Distances of right keypoints from the epipolar curve of the left keypoint whose descriptor
/// matches best in the whole image, both ways and clearly: no geometry takes part in the choice.
std::vector<double> epipolar_errors(const StereoRig& rig, const OrbFeatures& l,
                                    const OrbFeatures& r) {
  std::vector<double> errors;
  const Vector3d baseline = rig.T_right_left.translation.normalized();
  for (std::size_t i = 0; i < l.size(); ++i) {
    const NearestDescriptor best = nearest_descriptor(l.descriptors[i], r.descriptors);
    if (best.distance > 50 || best.distance > 0.7 * best.second_distance) continue;
    const auto j = static_cast<std::size_t>(best.position);
    if (nearest_descriptor(r.descriptors[j], l.descriptors).position !=
        static_cast<std::int32_t>(i))
      continue;
    const Vector3d ray_left = rig.T_right_left.rotation * rig.left.unproject({l.x[i], l.y[i]});
    const Vector3d ray_right = rig.right.unproject({r.x[j], r.y[j]});
    const Vector3d normal = baseline.cross(ray_left).normalized();
    errors.push_back(std::abs(std::asin(normal.dot(ray_right))) * rig.left.fx);
  }
  return errors;
}

/// Relative differences between depths measured in frame b and those predicted from frame a's.
std::vector<double> depth_differences(const StereoRig& rig, const FeatureSet& a,
                                      const FeatureSet& b, const SE3& T_b_a) {
  std::vector<double> differences;
  for (std::size_t i = 0; i < a.size(); ++i) {
    if (!a.has_depth(i) || a.depth_m[i] > 40 * rig.baseline_m) continue;
    const Vector3d ray = rig.left.unproject({a.x[i], a.y[i]});
    const Vector3d p = T_b_a * (ray * (a.depth_m[i] / ray.z()));
    if (p.z() < 0.1 || !rig.left.is_projectable(p)) continue;
    const Eigen::Vector2d pixel = rig.left.project(p);
    int best = 50;
    double difference = -1;
    for (std::size_t j = 0; j < b.size(); ++j) {
      if (!b.has_depth(j) || std::abs(b.x[j] - pixel.x()) > 15 || std::abs(b.y[j] - pixel.y()) > 15)
        continue;
      const int d = hamming_distance(a.descriptors[i], b.descriptors[j]);
      if (d >= best) continue;
      best = d;
      difference = std::abs(b.depth_m[j] / p.z() - 1);
    }
    if (difference >= 0) differences.push_back(difference);
  }
  return differences;
}

std::size_t stereo_count(const FeatureSet& f) {
  std::size_t n = 0;
  for (std::size_t i = 0; i < f.size(); ++i) n += f.has_depth(i);
  return n;
}

TEST(RealImages, EurocRowsAgreeAfterRectification) {
  cv::setNumThreads(1);  // as FrameBuilder has it
  const fs::path folder = data_folder("euroc_v101_sparse");
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  const Recording recording(folder / "mav0");
  ASSERT_EQ(recording.left.size(), 100u);
  const Calibration c = euroc();
  const Rectification rectification = Rectification::of_pair(c.cameras[0], c.cameras[1]);
  OrbExtractor extractor;
  std::vector<double> errors;
  for (std::size_t i = 0; i < 100; i += 5) {
    const FrameInput frame = recording.frame(i);
    ImageU8 left, right;
    rectification.apply(0, frame.left, left);
    rectification.apply(1, frame.right, right);
    const OrbFeatures l = extractor.extract(left);
    const auto e = epipolar_errors(rectification.rig(), l, extractor.extract(right));
    errors.insert(errors.end(), e.begin(), e.end());
  }
  EXPECT_GT(errors.size(), 20u * 50);
  EXPECT_LT(median(errors), 1.0);
  RecordProperty("median_epipolar_error_px", std::to_string(median(errors)));
}

TEST(RealImages, EurocDepthIsConsistentBetweenPairs) {
  const fs::path folder = data_folder("euroc_v101_sparse");
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  const Recording recording(folder / "mav0");
  const auto poses = read_poses(folder / "V101_GT_left_cam.txt");
  ASSERT_GT(poses.size(), 100u);
  const Calibration c = euroc();
  FrameBuilder builder(c, {});
  const SE3 T_camera_rectified = c.cameras[0].T_body_camera.inverse() * builder.rig().T_body_left;
  std::vector<double> counts, differences;
  FeatureSet previous;
  std::optional<SE3> T_world_previous;
  for (std::size_t i = 0; i < recording.left.size(); ++i) {
    const FeatureSet frame = builder.build(recording.frame(i));
    counts.push_back(static_cast<double>(stereo_count(frame)));
    std::optional<SE3> pose = pose_at(poses, recording.stamps[i]);
    if (pose) pose = *pose * T_camera_rectified;
    if (pose && T_world_previous) {
      const auto d =
          depth_differences(builder.rig(), previous, frame, pose->inverse() * *T_world_previous);
      differences.insert(differences.end(), d.begin(), d.end());
    }
    previous = frame;
    T_world_previous = pose;
  }
  EXPECT_GT(median(counts), 350);
  EXPECT_GT(differences.size(), 1000u);
  EXPECT_LT(median(differences), 0.03);
  RecordProperty("median_stereo_matches", std::to_string(median(counts)));
  RecordProperty("median_depth_difference", std::to_string(median(differences)));
}

TEST(RealImages, TumViFisheyePairsMatchAndAgree) {
  const fs::path folder = data_folder("tumvi_room1_3s");
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  const Recording recording(folder / "mav0");
  ASSERT_EQ(recording.left.size(), 60u);
  const auto poses = read_poses(folder / "mav0" / "mocap0" / "data.csv");
  FrameBuilder builder(tum_vi(), {});
  const StereoRig& rig = builder.rig();
  OrbExtractor extractor;
  std::vector<double> counts, errors, differences;
  FeatureSet previous;
  std::optional<SE3> T_world_previous;
  for (std::size_t i = 0; i < 60; i += 6) {
    const FrameInput input = recording.frame(i);
    const OrbFeatures l = extractor.extract(input.left);
    const auto e = epipolar_errors(rig, l, extractor.extract(input.right));
    errors.insert(errors.end(), e.begin(), e.end());
    const FeatureSet frame = builder.build(input);
    counts.push_back(static_cast<double>(stereo_count(frame)));
    std::optional<SE3> pose = pose_at(poses, recording.stamps[i]);
    if (pose) pose = *pose * rig.T_body_left;
    if (pose && T_world_previous) {
      const auto d = depth_differences(rig, previous, frame, pose->inverse() * *T_world_previous);
      differences.insert(differences.end(), d.begin(), d.end());
    }
    previous = frame;
    T_world_previous = pose;
  }
  EXPECT_GT(errors.size(), 10u * 50);
  EXPECT_LT(median(errors), 1.0);
  EXPECT_GT(median(counts), 200);
  EXPECT_GT(differences.size(), 300u);
  EXPECT_LT(median(differences), 0.05);
  RecordProperty("median_epipolar_error_px", std::to_string(median(errors)));
  RecordProperty("median_stereo_matches", std::to_string(median(counts)));
  RecordProperty("median_depth_difference", std::to_string(median(differences)));
}

}  // namespace
}  // namespace fastloop
