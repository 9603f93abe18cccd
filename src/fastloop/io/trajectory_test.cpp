#include "fastloop/io/trajectory.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <clocale>
#include <fstream>
#include <random>

#include "fastloop/core/error.hpp"

namespace fastloop::io {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

class TrajectoryFile : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = std::filesystem::path(::testing::TempDir()) /
              ("trajectory_" +
               std::string(::testing::UnitTest::GetInstance()->current_test_info()->name()));
    std::filesystem::remove_all(folder_);
    std::filesystem::create_directories(folder_);
  }
  void TearDown() override { std::filesystem::remove_all(folder_); }

  std::filesystem::path write(const std::string& name, const std::string& text) const {
    std::ofstream(folder_ / name, std::ios::binary) << text;
    return folder_ / name;
  }
  std::string error_of(const std::string& text, const TrajectoryOptions& options = {}) const {
    try {
      read_trajectory(write("bad.txt", text), options);
    } catch (const InputError& e) {
      return std::string(e.what()).substr((folder_ / "").string().size());
    }
    return "no error";
  }
  std::filesystem::path folder_;
};

TEST(ParseDecimal, IsExactWhereDoublesAreNot) {
  EXPECT_EQ(parse_decimal("1403715274.312142104", 9), 1403715274312142104);
  EXPECT_EQ(parse_decimal("1403715274312142104.0000000000", 0), 1403715274312142104);
  EXPECT_EQ(parse_decimal("1.403715274312142104e+09", 9), 1403715274312142104);
  EXPECT_EQ(parse_decimal("1403715274312142104", 0), 1403715274312142104);
  EXPECT_EQ(parse_decimal("-0.5", 9), -500000000);
  EXPECT_EQ(parse_decimal("3", 9), 3000000000);
  EXPECT_EQ(parse_decimal(".25", 1), 3);  // 2.5 rounds away from zero
  EXPECT_EQ(parse_decimal("0.0333333333333", 9), 33333333);
  EXPECT_EQ(parse_decimal("0.9999999999", 9), 1000000000);
  EXPECT_EQ(parse_decimal("1e-30", 9), 0);
}

TEST(ParseDecimal, RefusesWhatIsNotANumberOrDoesNotFit) {
  for (const char* text : {"", "-", ".", "nan", "inf", "1.2.3", "12a", "1e", "1e5x", "1 2", "0x10",
                           "99999999999999999999", "1e300"})
    EXPECT_EQ(parse_decimal(text, 0), std::nullopt) << text;
}

TEST(FormatSeconds, KeepsEveryNanosecond) {
  EXPECT_EQ(format_seconds(1403715274312142104), "1403715274.312142104");
  EXPECT_EQ(format_seconds(5), "0.000000005");
  EXPECT_EQ(format_seconds(-1500000000), "-1.500000000");
  std::mt19937_64 random(1);
  for (int i = 0; i < 1000; ++i) {
    const auto stamp_ns = static_cast<Nanoseconds>(random() >> 2);
    EXPECT_EQ(parse_decimal(format_seconds(stamp_ns), 9), stamp_ns);
  }
}

TEST_F(TrajectoryFile, WhatIsWrittenReadsBack) {
  std::mt19937 random(7);
  std::normal_distribution<double> normal;
  std::vector<StampedPose> poses;
  for (int i = 0; i < 200; ++i) {
    const Eigen::Quaterniond q(normal(random), normal(random), normal(random), normal(random));
    poses.push_back(
        {1403715274312142104 + i * 50'000'001LL,
         SE3(q.normalized(), 100 * Vector3d(normal(random), normal(random), normal(random)))});
  }
  write_tum(folder_ / "out.txt", poses);
  const Trajectory read = read_trajectory(folder_ / "out.txt");
  EXPECT_EQ(read.format, TrajectoryFormat::kTum);
  EXPECT_THAT(read.remarks, ElementsAre());
  ASSERT_EQ(read.poses.size(), poses.size());
  for (std::size_t i = 0; i < poses.size(); ++i) {
    EXPECT_EQ(read.poses[i].stamp_ns, poses[i].stamp_ns);
    EXPECT_LT(poses[i].T_world_x.local(read.poses[i].T_world_x).norm(), 5e-9);
  }
}

TEST(TumLine, DoesNotDependOnLocaleOrTheSignOfTheQuaternion) {
  const char* previous = std::setlocale(LC_ALL, "de_DE.UTF-8");
  const StampedPose a{1'000'000'001,
                      SE3(Eigen::Quaterniond(0.5, 0.5, -0.5, 0.5), {1.5, -1e-12, 3})};
  const StampedPose b{1'000'000'001, SE3(Eigen::Quaterniond(-0.5, -0.5, 0.5, -0.5), {1.5, 0, 3})};
  EXPECT_EQ(to_tum_line(a),
            "1.000000001 1.500000000 0.000000000 3.000000000 "
            "0.500000000 -0.500000000 0.500000000 0.500000000");
  EXPECT_EQ(to_tum_line(a), to_tum_line(b));
  if (previous) std::setlocale(LC_ALL, "C");
}

TEST_F(TrajectoryFile, WritingReportsAFullDiskAndAMissingFolder) {
  const std::vector<StampedPose> poses(10000);
  EXPECT_THROW(write_tum(folder_ / "no" / "such" / "folder.txt", poses), InputError);
  if (!std::filesystem::exists("/dev/full")) GTEST_SKIP() << "no /dev/full on this system";
  EXPECT_THROW(write_tum("/dev/full", poses), InputError);
}

TEST_F(TrajectoryFile, ReadsEurocGroundTruthWithFurtherColumnsAndCrlf) {
  const auto t = read_trajectory(
      write("data.csv",
            "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y "
            "[], q_RS_z [], v\r\n"
            "1403636579758555392,4.688,-1.786,0.783,0.5,-0.5,0.5,-0.5,0.1,0.2,0.3\r\n"
            "1403636579763555584,4.689,-1.787,0.787,0.5,-0.5,0.5,-0.5,0.1,0.2,0.3\r\n"));
  EXPECT_EQ(t.format, TrajectoryFormat::kEuroc);
  ASSERT_EQ(t.poses.size(), 2u);
  EXPECT_EQ(t.poses[1].stamp_ns, 1403636579763555584);
  EXPECT_EQ(t.poses[1].T_world_x.translation, Vector3d(4.689, -1.787, 0.787));
  EXPECT_DOUBLE_EQ(t.poses[1].T_world_x.rotation.w(), 0.5);
  EXPECT_DOUBLE_EQ(t.poses[1].T_world_x.rotation.z(), -0.5);
}

TEST_F(TrajectoryFile, ReadsPoseOnlyCsvWithFractionalStampsAndAHeaderWithoutHash) {
  const auto t = read_trajectory(write("vicon.csv",
                                       "timestamp,px,py,pz,qw,qx,qy,qz\n"
                                       "1403715274312142104.0000000000, 1, 2, 3, 1, 0, 0, 0\n"));
  EXPECT_EQ(t.format, TrajectoryFormat::kEuroc);
  EXPECT_EQ(t.poses[0].stamp_ns, 1403715274312142104);
  EXPECT_DOUBLE_EQ(t.poses[0].T_world_x.rotation.w(), 1);
}

TEST_F(TrajectoryFile, ReadsTumInNanosecondsAndWithByteOrderMark) {
  const auto t = read_trajectory(write("t.txt",
                                       "\xEF\xBB\xBF# comment\n\n"
                                       "1403715274312142104.000000 1 2 3 0 0 0 1\n"));
  EXPECT_EQ(t.poses[0].stamp_ns, 1403715274312142104);
  EXPECT_THAT(t.remarks, ElementsAre("stamps taken as nanoseconds"));
}

TEST_F(TrajectoryFile, KittiTakesStampsFromATimesFileOrAssumesTenHertz) {
  const std::string rows = "1 0 0 1 0 1 0 2 0 0 1 3\n0 -1 0 1 1 0 0 2 0 0 1 4\n";
  const auto file = write("07.txt", rows);
  const auto assumed = read_trajectory(file);
  EXPECT_EQ(assumed.format, TrajectoryFormat::kKitti);
  EXPECT_EQ(assumed.poses[1].stamp_ns, 100'000'000);
  EXPECT_EQ(assumed.poses[1].T_world_x.translation, Vector3d(1, 2, 4));
  EXPECT_NEAR(so3::log(assumed.poses[1].T_world_x.rotation).z(), std::acos(0.0), 1e-12);

  write("times.txt", "0\n1.037875e-01\n");
  EXPECT_EQ(read_trajectory(file).poses[1].stamp_ns, 103'787'500);
  const auto other = write("other_times.txt", "5\n6\n7\n");
  EXPECT_THROW(read_trajectory(file, {.kitti_times = other}), InputError);
}

TEST_F(TrajectoryFile, SortsAndDropsRepeatsWithARemark) {
  const auto t = read_trajectory(write("t.txt",
                                       "2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n"
                                       "2 9 0 0 0 0 0 1\n3 3 0 0 0 0 0 1\n"));
  ASSERT_EQ(t.poses.size(), 3u);
  EXPECT_EQ(t.poses[1].T_world_x.translation.x(), 2);
  EXPECT_THAT(t.remarks, ElementsAre("1 poses out of order: sorted",
                                     "1 repeated stamps: the first of each kept"));
}

TEST_F(TrajectoryFile, ErrorsNameFileLineAndExpectation) {
  EXPECT_THAT(error_of(""), HasSubstr("holds no poses"));
  EXPECT_THAT(error_of("# only a comment\n"), HasSubstr("holds no poses"));
  EXPECT_THAT(error_of("1 0 0 0 0 0 0 1\n2 0 0 junk 0 0 0 1\n"),
              HasSubstr("bad.txt:2: 'junk' is not a number"));
  EXPECT_THAT(error_of("1 0 0 0 0 0 0 1\n\n3 0 nan 0 0 0 0 1\n"),
              HasSubstr("bad.txt:3: 'nan' is not finite"));
  EXPECT_THAT(error_of("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n"), HasSubstr("bad.txt:2: 7 columns"));
  EXPECT_THAT(error_of("1 2 3\n"), HasSubstr("bad.txt:1: 3 columns (expected TUM"));
  EXPECT_THAT(error_of("1 0 0 0 0 0 0 0\n"), HasSubstr("quaternion has norm 0"));
  EXPECT_THAT(error_of("x 0 0 0 0 0 0 1\n"), HasSubstr("bad.txt:1"));
  EXPECT_THAT(error_of("1 0 0 1 0 1 0 2 0 0 2 3\n"), HasSubstr("not a rotation"));
  EXPECT_THAT(error_of("1e400,0,0,0,1,0,0,0\n"), HasSubstr("is not a time stamp"));
  EXPECT_THAT(error_of("1 0 0 0 0 0 0 1\n", {.format = TrajectoryFormat::kKitti}),
              HasSubstr("12 columns"));
  EXPECT_THROW(read_trajectory(folder_ / "missing.txt"), InputError);
  EXPECT_THROW(read_trajectory(folder_), InputError);
}

}  // namespace
}  // namespace fastloop::io
