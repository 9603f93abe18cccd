#pragma once

#include <cmath>

#include "fastloop/compute/host_device.hpp"

namespace fastloop {
struct Camera;
}

namespace fastloop::matching {

/// A camera as plain floats, for the search functor.
struct CameraView {
  int fisheye = 0;             ///< Kannala-Brandt; otherwise pinhole with radtan distortion
  int distorted = 0;           ///< pinhole with non-zero distortion
  float max_x = 0, max_y = 0;  ///< pixels of the last column and row
  float fx = 0, fy = 0, cx = 0, cy = 0;  ///< pixels
  float k[5] = {0, 0, 0, 0, 0};
  float max_theta = 0;  ///< fisheye: angle to which the model is monotonic
};

CameraView make_camera_view(const Camera& camera);

/// atan of u in [-1, 1] from additions, products and quotients only: the same bits on every IEEE
/// device. Error below 1e-7 rad.
FASTLOOP_HD inline float atan_unit(float u) {
  const float a = u < 0 ? -u : u;
  const bool reduce = a > 0.41421356f;  // tan(pi / 8)
  const float x = reduce ? (a - 1.0f) / (a + 1.0f) : a;
  const float z = x * x;
  const float tail =
      z * (-0.333327565f + z * (0.199718745f + z * (-0.138244114f + z * 0.0790248152f)));
  float angle = x + x * tail;
  if (reduce) angle += 0.785398163f;
  return u < 0 ? -angle : angle;
}

/// atan2(r, z) for r >= 0: angle from the optical axis, [0, pi].
FASTLOOP_HD inline float axis_angle(float r, float z) {
  if (r <= z) return z > 0 ? atan_unit(r / z) : 0.0f;
  if (r >= -z) return 1.57079633f - atan_unit(z / r);
  return 3.14159265f + atan_unit(r / z);
}

/// Pixel of a point in the camera frame; false where the camera does not see that direction: depth
/// <= 0 for a pinhole, beyond the monotonic range for a fisheye. The pixel may lie outside the
/// image.
FASTLOOP_HD inline bool project(const CameraView& c, const float p[3], float* u, float* v) {
  if (c.fisheye) {
    const float r = sqrtf(p[0] * p[0] + p[1] * p[1]);
    const float theta = axis_angle(r, p[2]);
    if (!(theta < c.max_theta) || !(r + (p[2] < 0 ? -p[2] : p[2]) > 1e-9f)) return false;
    const float t2 = theta * theta;
    const float theta_d =
        theta * (1.0f + t2 * (c.k[0] + t2 * (c.k[1] + t2 * (c.k[2] + t2 * c.k[3]))));
    const float s = r > 1e-12f ? theta_d / r : 0.0f;
    *u = c.fx * (s * p[0]) + c.cx;
    *v = c.fy * (s * p[1]) + c.cy;
    return true;
  }
  if (!(p[2] > 1e-9f)) return false;
  float x = p[0] / p[2], y = p[1] / p[2];
  if (c.distorted) {
    const float r2 = x * x + y * y;
    const float radial = 1.0f + r2 * (c.k[0] + r2 * (c.k[1] + r2 * c.k[4]));
    const float xy = x * y;
    const float xd = x * radial + 2.0f * c.k[2] * xy + c.k[3] * (r2 + 2.0f * x * x);
    y = y * radial + c.k[2] * (r2 + 2.0f * y * y) + 2.0f * c.k[3] * xy;
    x = xd;
  }
  *u = c.fx * x + c.cx;
  *v = c.fy * y + c.cy;
  return true;
}

/// False for NaN.
FASTLOOP_HD inline bool in_image(const CameraView& c, float u, float v) {
  return u >= 0.0f && v >= 0.0f && u <= c.max_x && v <= c.max_y;
}

}  // namespace fastloop::matching
