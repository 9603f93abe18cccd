// Any bytes given as a table end in well-ordered rows or in an InputError.
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <string_view>

#include "fastloop/core/error.hpp"
#include "fastloop/io/imu_recording.hpp"
#include "fastloop/io/sensor_csv.hpp"

namespace {

template <class Row>
void check_order(std::vector<Row> rows) {
  fastloop::io::order_by_stamp(rows);
  for (std::size_t i = 1; i < rows.size(); ++i)
    if (rows[i - 1].stamp_ns >= rows[i].stamp_ns) std::abort();
}

void parse(std::uint8_t choice, std::string_view text) {
  using namespace fastloop::io;
  switch (choice % 5) {
    case 0:
      return check_order(parse_image_csv(text, "fuzz.csv"));
    case 1:
      return check_order(parse_image_list(text, "fuzz.txt"));
    case 2:
      return check_order(parse_associations(text, "fuzz.txt"));
    case 3:
      parse_times(text, "fuzz.txt");
      return;
    default: {
      const ImuRecording imu = parse_imu_recording(text, "fuzz.csv", 0.01);
      check_order(imu.samples);
      for (const fastloop::ImuSample& s : imu.samples)
        if (!s.gyro.allFinite() || !s.accel.allFinite()) std::abort();
      if (imu_covering(imu.samples, 1000, 2000).size() > imu.samples.size()) std::abort();
    }
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size == 0) return 0;
  try {
    parse(data[0], {reinterpret_cast<const char*>(data) + 1, size - 1});
  } catch (const fastloop::InputError&) {
  }
  return 0;
}
