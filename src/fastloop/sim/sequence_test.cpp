#include "fastloop/sim/sequence.hpp"

#include <gtest/gtest.h>
#include <tbb/task_arena.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "fastloop/core/error.hpp"
#include "fastloop/io/calibration_yaml.hpp"
#include "fastloop/io/trajectory.hpp"
#include "fastloop/sim/sequence_writer.hpp"

namespace fastloop::sim {
namespace fs = std::filesystem;
namespace {

/// The same field of view on fewer pixels.
Calibration small_rig(CameraKind kind, int divisor) {
  Calibration c = make_rig(kind);
  for (CameraCalibration& camera : c.cameras) {
    camera.camera.width /= divisor;
    camera.camera.height /= divisor;
    for (double* k : {&camera.camera.fx, &camera.camera.fy, &camera.camera.cx, &camera.camera.cy}) *k /= divisor;
  }
  return c;
}

SequenceOptions small_options(CameraKind kind, double seconds = 0.4) {
  SequenceOptions options;
  options.camera = kind;
  options.seconds = seconds;
  options.rig = small_rig(kind, 4);
  return options;
}

fs::path fresh_folder(const std::string& name) {
  const fs::path folder = fs::path(::testing::TempDir()) / ("fastloop_sim_" + name);
  fs::remove_all(folder);
  return folder;
}

std::string read_all(const fs::path& file) {
  std::ostringstream text;
  text << std::ifstream(file, std::ios::binary).rdbuf();
  return text.str();
}

/// All files of a folder with their bytes.
std::map<std::string, std::string> contents(const fs::path& folder) {
  std::map<std::string, std::string> all;
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    if (entry.is_regular_file()) all[fs::relative(entry.path(), folder).string()] = read_all(entry.path());
  return all;
}

TEST(SimulatedSequence, FramesCarryImagesAndTheImuBetweenThem) {
  const SimulatedSequence s(small_options(CameraKind::kPinhole));
  ASSERT_EQ(s.size(), 9u);
  const FrameInput frame = s.frame(3);
  EXPECT_EQ(frame.left.width, 188);
  EXPECT_EQ(frame.right.height, 120);
  EXPECT_TRUE(frame.depth.empty());
  ASSERT_EQ(frame.imu.size(), 11u);
  EXPECT_EQ(frame.imu.front().stamp_ns, s.stamp_ns(2));
  EXPECT_EQ(frame.imu.back().stamp_ns, s.stamp_ns(3));
  EXPECT_THROW(s.frame(9), std::exception);
}

/// Mean absolute difference between the left image and the right one looked up through the true geometry.
TEST(SimulatedSequence, DepthCarriesOneImageIntoAnother) {
  SequenceOptions options;
  options.camera = CameraKind::kRgbd;
  options.seconds = 4;
  options.noise = false;
  options.rig = small_rig(CameraKind::kRgbd, 2);
  const SimulatedSequence s(options);
  const std::size_t i = 60, j = 63;
  const FrameInput a = s.frame(i), b = s.frame(j);
  const Camera& camera = s.calibration().cameras[0].camera;
  const SE3 T_b_a = s.ground_truth(s.stamp_ns(j)).T_world_body.inverse() * s.ground_truth(s.stamp_ns(i)).T_world_body;
  ASSERT_GT(T_b_a.translation.norm(), 0.02);
  int close = 0, total = 0;
  for (int y = 4; y < camera.height - 4; y += 3) {
    for (int x = 4; x < camera.width - 4; x += 3) {
      const float z = a.depth.at(x, y);
      if (z <= 0) continue;
      const Vector3d ray = camera.unproject({double(x), double(y)});
      const Vector3d p = T_b_a * Vector3d(ray * (z / ray.z()));
      const Eigen::Vector2d q = camera.project(p);
      if (!camera.contains(q, 2)) continue;
      const int u = static_cast<int>(q.x()), v = static_cast<int>(q.y());
      if (std::abs(b.depth.at(static_cast<int>(std::lround(q.x())), static_cast<int>(std::lround(q.y()))) - p.z()) >
          0.02 * p.z())
        continue;  // hidden
      const double fx = q.x() - u, fy = q.y() - v;
      const double value = (1 - fy) * ((1 - fx) * b.left.at(u, v) + fx * b.left.at(u + 1, v)) +
                           fy * ((1 - fx) * b.left.at(u, v + 1) + fx * b.left.at(u + 1, v + 1));
      ++total;
      close += std::abs(value - a.left.at(x, y)) < 12;
    }
  }
  EXPECT_GT(total, 3000);
  EXPECT_GT(close, 0.85 * total);
}

TEST(SimulatedSequence, ImagesHaveStrongTextureAllOver) {
  for (const WorldKind world : {WorldKind::kRoom, WorldKind::kHall, WorldKind::kCorridor, WorldKind::kCampus,
                               WorldKind::kCloister}) {
    SequenceOptions options;
    options.world = world;
    options.seconds = 6;
    options.rig = small_rig(CameraKind::kPinhole, 2);
    const SimulatedSequence s(options);
    const ImageU8 image = s.image(s.size() - 1, 0);
    int textured = 0, cells = 0;
    for (int y = 0; y + 24 <= image.height; y += 24) {
      for (int x = 0; x + 24 <= image.width; x += 24) {
        int low = 255, high = 0;
        for (int v = y; v < y + 24; ++v)
          for (int u = x; u < x + 24; ++u) {
            low = std::min<int>(low, image.at(u, v));
            high = std::max<int>(high, image.at(u, v));
          }
        ++cells;
        textured += high - low > 40;
      }
    }
    EXPECT_GT(textured, (world == WorldKind::kCampus ? 0.6 : 0.85) * cells) << to_string(world);
  }
}

TEST(SimulatedSequence, DepthHasHolesAndNoiseThatGrows) {
  SequenceOptions options = small_options(CameraKind::kRgbd);
  const SimulatedSequence noisy(options);
  options.noise = false;
  const SimulatedSequence exact(options);
  const ImageF32 a = noisy.frame(5).depth, b = exact.frame(5).depth;
  double near2 = 0, far2 = 0;
  int near = 0, far = 0, holes = 0;
  for (std::size_t i = 0; i < a.pixels.size(); ++i) {
    if (a.pixels[i] <= 0) {
      ++holes;
      continue;
    }
    ASSERT_LE(a.pixels[i], 8.5f);
    const double e = a.pixels[i] - b.pixels[i];
    if (b.pixels[i] < 2) near2 += e * e, ++near;
    if (b.pixels[i] > 3.5) far2 += e * e, ++far;
  }
  EXPECT_GT(holes, 100);
  EXPECT_LT(holes, static_cast<int>(a.pixels.size() / 3));
  ASSERT_GT(near, 100);
  ASSERT_GT(far, 100);
  EXPECT_LT(std::sqrt(near2 / near), 0.007);
  EXPECT_GT(std::sqrt(far2 / far), 0.015);
  EXPECT_LT(std::sqrt(far2 / far), 0.15);
}

TEST(SimulatedSequence, RefusesBadOptions) {
  SequenceOptions options;
  options.seconds = -1;
  EXPECT_THROW(SimulatedSequence{options}, InvalidArgument);
  options.seconds = std::nan("");
  EXPECT_THROW(SimulatedSequence{options}, InvalidArgument);
  options.seconds = 1;
  options.recorded_imu = "imu.csv";
  EXPECT_THROW(SimulatedSequence{options}, InvalidArgument);
  options.motion = "no/such/file.csv";
  EXPECT_THROW(SimulatedSequence{options}, InputError);
  EXPECT_THROW(parse_world_kind("garden"), InvalidArgument);
  EXPECT_THROW(parse_camera_kind("pinhole2"), InvalidArgument);
}

TEST(SequenceWriter, BytesDoNotDependOnThreads) {
  for (const CameraKind camera : {CameraKind::kPinhole, CameraKind::kFisheye, CameraKind::kRgbd}) {
    const fs::path one = fresh_folder("one"), three = fresh_folder("three");
    write_sequence(SimulatedSequence(small_options(camera, 0.2)), {one, 1, {}});
    write_sequence(SimulatedSequence(small_options(camera, 0.2)), {three, 3, {}});
    const auto a = contents(one), b = contents(three);
    EXPECT_GT(a.size(), 10u);
    EXPECT_EQ(a, b) << to_string(camera);
  }
}

TEST(SequenceWriter, GroundTruthFilesHoldTheTruth) {
  const fs::path folder = fresh_folder("truth");
  const SimulatedSequence stereo(small_options(CameraKind::kPinhole));
  write_sequence(stereo, {folder, 0, {}});
  const io::Trajectory truth = io::read_trajectory(folder / "mav0/state_groundtruth_estimate0/data.csv");
  ASSERT_EQ(truth.poses.size(), 81u);
  for (const io::StampedPose& p : truth.poses) {
    const SE3 exact = stereo.ground_truth(p.stamp_ns).T_world_body;
    EXPECT_LT((p.T_world_x.translation - exact.translation).norm(), 1e-8);
    EXPECT_LT(angle_between(p.T_world_x, exact), 1e-8);
  }
  const fs::path rgbd_folder = fresh_folder("truth_rgbd");
  const SimulatedSequence rgbd(small_options(CameraKind::kRgbd));
  write_sequence(rgbd, {rgbd_folder, 0, {}});
  EXPECT_EQ(io::read_trajectory(rgbd_folder / "groundtruth.txt").poses.size(), rgbd.size());
  const Calibration read = io::load_calibration(rgbd_folder / "calibration.yaml");
  EXPECT_EQ(read.depth->units_per_metre, 5000);
  EXPECT_EQ(read.cameras[0].camera.fx, rgbd.calibration().cameras[0].camera.fx);
}

TEST(SequenceWriter, OpensAsADataSet) {
  for (const CameraKind camera : {CameraKind::kPinhole, CameraKind::kFisheye, CameraKind::kRgbd}) {
    const fs::path folder = fresh_folder("open");
    const SimulatedSequence s(small_options(camera, 0.2));
    write_sequence(s, {folder, 0, {}});
    const auto dataset = io::open_dataset(folder);
    ASSERT_EQ(dataset->size(), s.size());
    EXPECT_TRUE(dataset->remarks().empty());
    const FrameInput a = dataset->load(2), b = s.frame(2);
    EXPECT_EQ(a.stamp_ns, b.stamp_ns);
    EXPECT_EQ(a.left.pixels, b.left.pixels);
    EXPECT_EQ(a.right.pixels, b.right.pixels);
    ASSERT_EQ(a.imu.size(), b.imu.size());
    for (std::size_t i = 0; i < a.imu.size(); ++i) EXPECT_LT((a.imu[i].accel - b.imu[i].accel).norm(), 1e-9);
    ASSERT_EQ(a.depth.pixels.size(), b.depth.pixels.size());
    for (std::size_t i = 0; i < a.depth.pixels.size(); ++i) ASSERT_NEAR(a.depth.pixels[i], b.depth.pixels[i], 1e-5);
    const Calibration &x = dataset->calibration(), &y = s.calibration();
    ASSERT_EQ(x.cameras.size(), y.cameras.size());
    for (std::size_t c = 0; c < x.cameras.size(); ++c) {
      EXPECT_EQ(x.cameras[c].camera.model, y.cameras[c].camera.model);
      EXPECT_NEAR(x.cameras[c].camera.fx, y.cameras[c].camera.fx, 1e-9);
      EXPECT_LT(x.cameras[c].T_body_camera.local(y.cameras[c].T_body_camera).norm(), 1e-8);
    }
  }
}

TEST(SequenceWriter, RecordedMotionIsFlownAgainWithItsImu) {
  const fs::path folder = fresh_folder("first"), again = fresh_folder("again");
  SequenceOptions options = small_options(CameraKind::kPinhole, 1);
  const SimulatedSequence first(options);
  write_sequence(first, {folder, 0, {}});
  options.motion = folder / "mav0/state_groundtruth_estimate0/data.csv";
  options.recorded_imu = folder / "mav0/imu0/data.csv";
  options.seconds = 0;
  const SimulatedSequence second(options);
  ASSERT_EQ(second.size(), first.size());
  for (std::size_t i = 0; i < first.size(); ++i) {
    ASSERT_EQ(second.stamp_ns(i), first.stamp_ns(i));
    const SE3 a = first.ground_truth(first.stamp_ns(i)).T_world_body, b = second.ground_truth(first.stamp_ns(i)).T_world_body;
    EXPECT_LT((a.translation - b.translation).norm(), 1e-3);
    EXPECT_LT(angle_between(a, b), 1e-3);
  }
  write_sequence(second, {again, 0, {}});
  EXPECT_EQ(read_all(folder / "mav0/imu0/data.csv"), read_all(again / "mav0/imu0/data.csv"));
}

TEST(SequenceWriter, ReplacesAnEarlierSimulationAndNothingElse) {
  const fs::path folder = fresh_folder("replace");
  write_sequence(SimulatedSequence(small_options(CameraKind::kPinhole, 0.3)), {folder, 0, {}});
  write_sequence(SimulatedSequence(small_options(CameraKind::kRgbd, 0.1)), {folder, 0, {}});
  EXPECT_FALSE(fs::exists(folder / "mav0"));
  EXPECT_TRUE(fs::exists(folder / "rgb.txt"));

  const fs::path foreign = fresh_folder("foreign");
  fs::create_directories(foreign);
  std::ofstream(foreign / "thesis.tex") << "work";
  EXPECT_THROW(write_sequence(SimulatedSequence(small_options(CameraKind::kRgbd, 0.1)), {foreign, 0, {}}), InputError);
  EXPECT_EQ(contents(foreign).size(), 1u);
}

TEST(SequenceWriter, NamesWhatItCannotWrite) {
  const SimulatedSequence s(small_options(CameraKind::kRgbd, 0.1));
  const fs::path folder = fresh_folder("file");
  std::ofstream(folder) << "a file, not a folder";
  try {
    write_sequence(s, {folder, 0, {}});
    FAIL() << "no error";
  } catch (const InputError& e) {
    EXPECT_EQ(e.where().file, folder.string());
  }
  EXPECT_THROW(write_sequence(s, {folder / "below", 0, {}}), InputError);
  // The kernel's always full device stands for a full disk.
  if (!fs::exists("/dev/full")) GTEST_SKIP() << "no /dev/full here";
  const std::string bytes(100000, 'x');
  EXPECT_THROW(write_bytes("/dev/full", bytes.data(), bytes.size()), InputError);
}

}  // namespace
}  // namespace fastloop::sim
