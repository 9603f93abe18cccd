#include "fastloop/io/kitti_calibration.hpp"

#include <Eigen/LU>
#include <cmath>
#include <sstream>

#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

using Projection = Eigen::Matrix<double, 3, 4, Eigen::RowMajor>;

struct Line {
  Projection p;
  int number = 0;
};

Line find_projection(const std::string& text, const std::string& file, const std::string& name) {
  std::istringstream in(text);
  std::string line;
  for (int number = 1; std::getline(in, line); ++number) {
    std::istringstream words(line);
    std::string word;
    if (!(words >> word) || (word != name && word != name + ":")) continue;
    Line found{Projection::Zero(), number};
    Eigen::Index count = 0;
    for (; words >> word; ++count) {
      const auto value = parse_number(word);
      if (!value || !std::isfinite(*value))
        throw InputError(in_file(file, number, name),
                         "'" + word.substr(0, 40) + "' is not a finite number", "12 numbers");
      if (count < 12) found.p.data()[count] = *value;
    }
    if (count != 12)
      throw InputError(in_file(file, number, name), "has " + std::to_string(count) + " numbers",
                       "12 numbers");
    return found;
  }
  throw InputError(in_file(file, 0, name), "is missing", "a line " + name + ": with 12 numbers");
}

}  // namespace

Calibration parse_kitti_calibration(const std::string& text, const std::string& file,
                                    int left_camera, int width, int height) {
  Calibration c;
  Vector3d offset[2];
  for (int i = 0; i < 2; ++i) {
    const std::string name = "P" + std::to_string(left_camera + i);
    const Line line = find_projection(text, file, name);
    const Matrix3d k = line.p.leftCols<3>();
    if (k(0, 0) <= 0 || k(1, 1) <= 0 || std::abs(k(2, 2) - 1) > 1e-6)
      throw InputError(in_file(file, line.number, name), "is not a camera matrix",
                       "fx, fy > 0 and a last row 0 0 1");
    offset[i] = k.inverse() * line.p.col(3);
    Camera camera;
    camera.width = width, camera.height = height;
    camera.fx = k(0, 0), camera.fy = k(1, 1), camera.cx = k(0, 2), camera.cy = k(1, 2);
    c.cameras.push_back({camera, SE3(), 10});
  }
  // p_camera_i = p_camera_0 + offset_i, for rectified cameras that all look the same way.
  c.cameras[1].T_body_camera.translation = offset[0] - offset[1];
  try {
    c.validate();
  } catch (const InvalidArgument& e) {
    throw InputError(in_file(file), e.what());
  }
  return c;
}

}  // namespace fastloop::io
