// Any bytes given as a calibration end in a valid calibration or in an InputError.
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <string>

#include "fastloop/core/error.hpp"
#include "fastloop/io/calibration_import.hpp"
#include "fastloop/io/calibration_report.hpp"
#include "fastloop/io/calibration_yaml.hpp"
#include "fastloop/io/kitti_calibration.hpp"

namespace {

fastloop::Calibration parse(std::uint8_t choice, const std::string& text) {
  using namespace fastloop::io;
  const NamedText named{text, "fuzz.yaml"};
  switch (choice % 6) {
    case 0:
      return parse_calibration(text, "fuzz.yaml");
    case 1:
      return parse_kalibr(named, {}).calibration;
    case 2:
      return parse_orb_slam(named).calibration;
    case 3:
      return parse_euroc_sensors({named, named}, {}).calibration;
    case 4:
      return parse_kitti_calibration(text, "fuzz.txt", 0, 1241, 376);
    default: {
      const std::size_t half = text.size() / 2;
      return parse_kalibr({text.substr(0, half), "a"}, NamedText{text.substr(half), "b"})
          .calibration;
    }
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size == 0) return 0;
  const std::string text(reinterpret_cast<const char*>(data) + 1, size - 1);
  try {
    fastloop::io::recognise_calibration({text, "fuzz.yaml"});
  } catch (const fastloop::InputError&) {
  }
  try {
    const fastloop::Calibration calibration = parse(data[0], text);
    calibration.validate();
    // Whatever was accepted can be described, written and read again.
    if (fastloop::io::describe_calibration(calibration).empty()) std::abort();
    const std::string yaml = fastloop::io::to_yaml(calibration);
    if (fastloop::io::parse_calibration(yaml, "again").cameras.size() != calibration.cameras.size())
      std::abort();
  } catch (const fastloop::InputError&) {
  }
  return 0;
}
