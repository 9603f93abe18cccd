#include "fastloop/io/imu_recording.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>

#include "fastloop/io/test_support.hpp"

namespace fastloop::io {
namespace {

using testing::AllOf;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;

std::string row(Nanoseconds stamp, const std::string& values = "1,2,3,4,5,6") {
  return std::to_string(stamp) + "," + values + "\n";
}

std::vector<Nanoseconds> stamps(std::span<const ImuSample> samples) {
  std::vector<Nanoseconds> all;
  for (const ImuSample& s : samples) all.push_back(s.stamp_ns);
  return all;
}

TEST(ImuRecording, ToleratesLineEndsBlankLinesCommentsAndHeadings) {
  const std::string text =
      "\xEF\xBB\xBFtimestamp,wx,wy,wz,ax,ay,az\r\n# comment\r\n\r\n 10 , 1 ,2,3,4,5, 6 "
      "\r\n20,1,2,3,4,5,6,\r\n"
      "30,-1e-3,+2,3,4,5,6";
  const ImuRecording imu = parse_imu_recording(text, "imu.csv", 0);
  EXPECT_THAT(stamps(imu.samples), ElementsAre(10, 20, 30));
  EXPECT_THAT(imu.remarks, IsEmpty());
  EXPECT_EQ(imu.samples[0].gyro, Vector3d(1, 2, 3));
  EXPECT_EQ(imu.samples[2].gyro, Vector3d(-1e-3, 2, 3));
  EXPECT_EQ(imu.samples[2].accel, Vector3d(4, 5, 6));
}

TEST(ImuRecording, SortsAndRemovesDuplicates) {
  const ImuRecording imu = parse_imu_recording(
      row(10) + row(30) + row(20, "9,9,9,9,9,9") + row(20) + row(40), "imu.csv", 0);
  EXPECT_THAT(stamps(imu.samples), ElementsAre(10, 20, 30, 40));
  EXPECT_EQ(imu.samples[1].gyro.x(), 9) << "the first of a stamp is kept";
  EXPECT_THAT(imu.remarks,
              ElementsAre("imu.csv: 1 unordered row(s) sorted, 1 duplicate stamp(s) removed"));
}

TEST(ImuRecording, DropsNotFiniteSamplesAndNamesTheirLines) {
  const ImuRecording imu = parse_imu_recording(
      "#heading\n" + row(10) + row(20, "nan,2,3,4,5,6") + row(30) + row(40, "1,2,3,4,5,inf"),
      "imu.csv", 0);
  EXPECT_THAT(stamps(imu.samples), ElementsAre(10, 30));
  EXPECT_THAT(imu.remarks,
              ElementsAre("imu.csv: 2 sample(s) with NaN or infinity dropped (line 3, 5)"));
}

TEST(ImuRecording, SaysWhereSamplesAreMissing) {
  std::string text;
  for (int i = 0; i < 20; ++i) text += row(5'000'000LL * i);
  for (int i = 40; i < 60; ++i) text += row(5'000'000LL * i);
  const ImuRecording imu = parse_imu_recording(text, "imu.csv", 0);
  ASSERT_EQ(imu.remarks.size(), 1u);
  EXPECT_THAT(imu.remarks[0],
              AllOf(HasSubstr("imu.csv: 1 gap(s)"), HasSubstr("0.105 s after stamp 95000000"),
                    HasSubstr("0.095 s from the start")));
}

TEST(ImuRecording, GapsOfTenIntervalsAreNotRemarked) {
  std::string text;
  for (int i = 0; i < 20; ++i) text += row(5'000'000LL * i);
  for (int i = 29; i < 40; ++i) text += row(5'000'000LL * i);
  EXPECT_THAT(parse_imu_recording(text, "imu.csv", 0).remarks, IsEmpty());
}

TEST(ImuRecording, RejectsJunkWithFileAndLine) {
  for (const std::string junk :
       {"20,1,2,3,4,5", "20,1,2,3,4,5,6,7", "20,1,2,x,4,5,6", "twenty,1,2,3,4,5,6",
        "20;1;2;3;4;5;6", "-20,1,2,3,4,5,6", "20,1,2,,4,5,6", "99999999999999999999,1,2,3,4,5,6"}) {
    const std::string message = input_error(
        [&] { parse_imu_recording("#heading\n" + row(10) + junk + "\n", "imu.csv", 0); });
    EXPECT_THAT(message,
                AllOf(HasSubstr("imu.csv:3:"), HasSubstr(junk), HasSubstr("3 angular rates")))
        << junk;
  }
}

TEST(ImuRecording, TimeShiftBringsStampsIntoCameraTime) {
  // t_imu = t_camera + shift: an IMU clock that is 4 ms ahead must be set back.
  const ImuRecording imu = parse_imu_recording(row(10'000'000) + row(15'000'000), "imu.csv", 0.004);
  EXPECT_THAT(stamps(imu.samples), ElementsAre(6'000'000, 11'000'000));
}

TEST(ImuCovering, ReachesOneSampleBeyondBothEnds) {
  std::vector<ImuSample> samples(6);
  for (std::size_t i = 0; i < samples.size(); ++i)
    samples[i].stamp_ns = static_cast<Nanoseconds>(10 * i);
  EXPECT_THAT(stamps(imu_covering(samples, 12, 33)), ElementsAre(10, 20, 30, 40));
  EXPECT_THAT(stamps(imu_covering(samples, 10, 30)), ElementsAre(10, 20, 30))
      << "stamps that coincide";
  EXPECT_THAT(stamps(imu_covering(samples, 12, 12)), ElementsAre(10, 20));
  EXPECT_THAT(stamps(imu_covering(samples, 20, 20)), ElementsAre(20));
  EXPECT_THAT(stamps(imu_covering(samples, -50, 5)), ElementsAre(0, 10))
      << "before the first sample";
  EXPECT_THAT(stamps(imu_covering(samples, 45, 99)), ElementsAre(40, 50))
      << "after the last sample";
  EXPECT_THAT(stamps(imu_covering(samples, 60, 99)), ElementsAre(50));
  EXPECT_THAT(stamps(imu_covering({}, 1, 2)), IsEmpty());
}

}  // namespace
}  // namespace fastloop::io
