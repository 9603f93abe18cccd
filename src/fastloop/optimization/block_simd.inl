// Vector arithmetic for the kernels. Included inside an anonymous namespace by block_kernels_*.cpp
// after FASTLOOP_SIMD_LANES is defined; relies on the vector extensions of GCC and Clang.

constexpr int kSimd = FASTLOOP_SIMD_LANES;
typedef double Vec __attribute__((vector_size(kSimd * sizeof(double))));
typedef double VecUnaligned
    __attribute__((vector_size(kSimd * sizeof(double)), aligned(8), may_alias));
typedef long long VecMask __attribute__((vector_size(kSimd * sizeof(double))));

#define FASTLOOP_INLINE static inline __attribute__((always_inline))

FASTLOOP_INLINE Vec load(const double* p) {
  return *reinterpret_cast<const VecUnaligned*>(p);
}
FASTLOOP_INLINE void store(double* p, Vec v) {
  *reinterpret_cast<VecUnaligned*>(p) = v;
}
FASTLOOP_INLINE Vec splat(double x) {
  return Vec{} + x;
}

struct Vec3 {
  Vec x, y, z;
};
FASTLOOP_INLINE Vec3 operator+(Vec3 a, Vec3 b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
FASTLOOP_INLINE Vec3 operator-(Vec3 a, Vec3 b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
FASTLOOP_INLINE Vec3 operator*(Vec s, Vec3 a) {
  return {s * a.x, s * a.y, s * a.z};
}
FASTLOOP_INLINE Vec dot(Vec3 a, Vec3 b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
FASTLOOP_INLINE Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

struct Quat {
  Vec3 v;
  Vec w;
};
FASTLOOP_INLINE Quat conjugate(Quat q) {
  return {{-q.v.x, -q.v.y, -q.v.z}, q.w};
}
FASTLOOP_INLINE Quat operator*(Quat a, Quat b) {
  return {a.w * b.v + b.w * a.v + cross(a.v, b.v), a.w * b.w - dot(a.v, b.v)};
}
FASTLOOP_INLINE Vec3 rotate(Quat q, Vec3 p) {
  const Vec3 t = (Vec{} + 2.0) * cross(q.v, p);
  return p + q.w * t + cross(q.v, t);
}

/// Columns of a 3 x 3 matrix.
struct Mat3 {
  Vec3 c0, c1, c2;
};
FASTLOOP_INLINE Vec3 operator*(const Mat3& m, Vec3 p) {
  return p.x * m.c0 + p.y * m.c1 + p.z * m.c2;
}
FASTLOOP_INLINE Mat3 operator*(const Mat3& a, const Mat3& b) {
  return {a * b.c0, a * b.c1, a * b.c2};
}
FASTLOOP_INLINE Mat3 operator+(const Mat3& a, const Mat3& b) {
  return {a.c0 + b.c0, a.c1 + b.c1, a.c2 + b.c2};
}
FASTLOOP_INLINE Mat3 operator-(const Mat3& a, const Mat3& b) {
  return {a.c0 - b.c0, a.c1 - b.c1, a.c2 - b.c2};
}
FASTLOOP_INLINE Mat3 operator*(Vec s, const Mat3& a) {
  return {s * a.c0, s * a.c1, s * a.c2};
}
FASTLOOP_INLINE Mat3 hat(Vec3 v) {
  const Vec zero = {};
  return {{zero, v.z, -v.y}, {-v.z, zero, v.x}, {v.y, -v.x, zero}};
}
FASTLOOP_INLINE Mat3 diagonal(Vec s) {
  const Vec zero = {};
  return {{s, zero, zero}, {zero, s, zero}, {zero, zero, s}};
}
/// a b^T
FASTLOOP_INLINE Mat3 outer(Vec3 a, Vec3 b) {
  return {b.x * a, b.y * a, b.z * a};
}
FASTLOOP_INLINE Mat3 rotation_matrix(Quat q) {
  const Vec x2 = q.v.x + q.v.x, y2 = q.v.y + q.v.y, z2 = q.v.z + q.v.z;
  const Vec xx = q.v.x * x2, yy = q.v.y * y2, zz = q.v.z * z2;
  const Vec xy = q.v.x * y2, xz = q.v.x * z2, yz = q.v.y * z2;
  const Vec wx = q.w * x2, wy = q.w * y2, wz = q.w * z2;
  return {{1.0 - (yy + zz), xy + wz, xz - wy},
          {xy - wz, 1.0 - (xx + zz), yz + wx},
          {xz + wy, yz - wx, 1.0 - (xx + yy)}};
}
FASTLOOP_INLINE Mat3 transpose(const Mat3& m) {
  return {{m.c0.x, m.c1.x, m.c2.x}, {m.c0.y, m.c1.y, m.c2.y}, {m.c0.z, m.c1.z, m.c2.z}};
}
