// Residuals and derivatives of a batch of edges. docs/pose-graph.md holds the derivation;
// pose_graph_residual.cpp is the same mathematics for one edge, without series, and takes over for
// residuals beyond the reach of the series here.

template <EdgeModel M>
struct ModelTraits {
  static constexpr bool kYaw = M == EdgeModel::kYaw;
  static constexpr bool kLog = M == EdgeModel::kSim3 || M == EdgeModel::kSim3FixedScale;
  static constexpr int kTangent = kYaw ? 4 : M == EdgeModel::kSim3 ? 7 : 6;
  static constexpr int kResidual = kLog ? 7 : 6;
};

/// Derivative with respect to `to`, in the blocks that are not zero:
///   kYaw    [a; d] for the angle, [0; b] for the translation
///   others  rows rotation [A 0 0], translation [C B d], log scale [0 0 1]
struct Derivative {
  Mat3 a, b, c;
  Vec3 d, yaw;
};

struct EdgeState {
  Quat q_to;
  Vec3 t_to;
  Vec s_to;
  Quat q_error;  // not for kYaw
  Vec3 e_rotation, e_translation;
  Vec e_scale;
  Quat q_from;
};

FASTLOOP_INLINE Vec gather(const double* base, const std::int32_t* index, int field) {
  Vec r;
  for (int l = 0; l < kSimd; ++l) r[l] = base[static_cast<std::size_t>(index[l]) * 8 + field];
  return r;
}

/// asin(n) / n as a series of n^2; used for n < 0.2474, a rotation of 0.5 rad.
FASTLOOP_INLINE Vec asin_over(Vec n_sq) {
  constexpr double k[14] = {1.0,
                            0.16666666666666666,
                            0.075,
                            0.044642857142857144,
                            0.030381944444444444,
                            0.022372159090909092,
                            0.017352764423076924,
                            0.01396484375,
                            0.011551800896139705,
                            0.009761609529194078,
                            0.008390335809616815,
                            0.0073125258735988454,
                            0.006447210311889649,
                            0.005740037670841924};
  Vec r = splat(k[13]);
  for (int i = 12; i >= 0; --i) r = r * n_sq + k[i];
  return r;
}

/// log(s) = 2 artanh((s - 1) / (s + 1)) for |log s| < 0.48.
FASTLOOP_INLINE Vec log_near_one(Vec y, Vec y_sq) {
  Vec r = splat(1.0 / 27);
  for (int i = 12; i >= 0; --i) r = r * y_sq + 1.0 / (2 * i + 1);
  return (y + y) * r;
}

/// B_2k / (2k)!: the even part of x / (e^x - 1) is 1 + sum of k[i] x^(2i + 2).
constexpr double kBernoulli[8] = {
    0.08333333333333333,  -0.001388888888888889,  3.306878306878307e-05,  -8.267195767195768e-07,
    2.08767569878681e-08, -5.284190138687493e-10, 1.3382536530684679e-11, -3.3896802963225827e-13};

/// Even part, without the leading 1, of x / (e^x - 1) at x = hat(phi) + sigma I, as c I + a hat + b
/// hat^2: with (sigma + i theta)^2k = u + i theta v the recurrences below never divide by theta.
struct SeriesFunction {
  Vec c, a, b;
};
FASTLOOP_INLINE void multiply_by_square(SeriesFunction& f, Vec& u, Vec theta_sq, Vec sigma) {
  const Vec sigma_sq = sigma * sigma, two_sigma = sigma + sigma;
  const Vec b = f.b * sigma_sq + u + two_sigma * f.a;
  const Vec a = u * two_sigma + f.a * (sigma_sq - theta_sq);
  u = u * (sigma_sq - theta_sq) - theta_sq * f.a * two_sigma;
  f = {f.c * sigma_sq, a, b};
}
FASTLOOP_INLINE SeriesFunction even_part(Vec theta_sq, Vec sigma) {
  SeriesFunction f{splat(kBernoulli[7]), Vec{}, Vec{}};
  Vec u = f.c;
  for (int k = 6; k >= 0; --k) {
    multiply_by_square(f, u, theta_sq, sigma);
    f.c += kBernoulli[k];
    u += kBernoulli[k];
  }
  multiply_by_square(f, u, theta_sq, sigma);
  return f;
}

FASTLOOP_INLINE Vec3 apply(const SeriesFunction& f, Vec3 phi, Vec3 p) {
  const Vec3 w = cross(phi, p);
  return f.c * p + f.a * w + f.b * cross(phi, w);
}
FASTLOOP_INLINE Mat3 matrix_of(const SeriesFunction& f, Vec3 phi, Vec theta_sq) {
  return diagonal(f.c - f.b * theta_sq) + f.a * hat(phi) + f.b * outer(phi, phi);
}

/// Rotation vector of a unit quaternion; lanes beyond the series get a nonzero `far`.
FASTLOOP_INLINE Vec3 log_rotation(Quat q, VecMask& far) {
  const Vec sign = q.w < 0.0 ? splat(-2.0) : splat(2.0);
  const Vec n_sq = dot(q.v, q.v);
  far |= ~(n_sq < 0.0611);
  return (sign * asin_over(n_sq)) * q.v;
}

template <EdgeModel M>
FASTLOOP_INLINE EdgeState residual_of(const PassContext& ctx, const std::int32_t* from,
                                      const std::int32_t* to, const double* z, VecMask& far) {
  using T = ModelTraits<M>;
  EdgeState s;
  const double* p = ctx.poses;
  s.q_from = {{gather(p, from, 0), gather(p, from, 1), gather(p, from, 2)}, gather(p, from, 3)};
  const Vec3 t_from = {gather(p, from, 4), gather(p, from, 5), gather(p, from, 6)};
  s.q_to = {{gather(p, to, 0), gather(p, to, 1), gather(p, to, 2)}, gather(p, to, 3)};
  s.t_to = {gather(p, to, 4), gather(p, to, 5), gather(p, to, 6)};
  const Quat q_z = {{load(z), load(z + kLanes), load(z + 2 * kLanes)}, load(z + 3 * kLanes)};
  const Vec3 t_z = {load(z + 4 * kLanes), load(z + 5 * kLanes), load(z + 6 * kLanes)};
  const Vec3 difference = rotate(conjugate(s.q_from), s.t_to - t_from);
  if constexpr (T::kYaw) {
    s.e_rotation = log_rotation(conjugate(s.q_from) * s.q_to * q_z, far);
    s.e_translation = difference - t_z;
    return s;
  }
  s.q_error = q_z * (conjugate(s.q_from) * s.q_to);
  if constexpr (M == EdgeModel::kSe3) {
    const Vec sign = s.q_error.w < 0.0 ? splat(-1.0) : splat(1.0);
    s.e_rotation = sign * s.q_error.v;
    s.e_translation = rotate(q_z, difference) + t_z;
  }
  if constexpr (T::kLog) {
    const Vec s_z = load(z + 7 * kLanes);
    const Vec s_from = gather(p, from, 7);
    s.s_to = gather(p, to, 7);
    const Vec s_z_from = s_z / s_from, scale = s_z_from * s.s_to;
    const Vec3 t = s_z_from * rotate(q_z, difference) + t_z;
    s.e_rotation = log_rotation(s.q_error, far);
    const Vec y = (scale - 1.0) / (scale + 1.0), y_sq = y * y;
    far |= ~(y_sq < 0.056);
    s.e_scale = log_near_one(y, y_sq);
    const Vec theta_sq = dot(s.e_rotation, s.e_rotation);
    SeriesFunction f = even_part(theta_sq, s.e_scale);
    f.c += 1.0 - 0.5 * s.e_scale;
    f.a -= 0.5;
    s.e_translation = apply(f, s.e_rotation, t);
  }
  return s;
}

/// Lower left block and last column of the inverse right Jacobian: five terms of the series leave a
/// relative error of 1e-11 at the border of the fast path, which a derivative does not notice.
FASTLOOP_INLINE void off_diagonal_blocks(const EdgeState& s, Vec theta_sq, Mat3& k21, Vec3& k23) {
  const Vec3 phi = s.e_rotation, rho = s.e_translation;
  const Vec sigma = s.e_scale;
  const Mat3 p = hat(rho);
  const Vec minus_two_dot = -2.0 * dot(phi, rho);
  const Mat3 m = outer(rho, phi) + outer(phi, rho) + diagonal(minus_two_dot) + sigma * p;
  const auto apply_columns = [&](const SeriesFunction& f) {
    return Mat3{apply(f, phi, m.c0), apply(f, phi, m.c1), apply(f, phi, m.c2)};
  };
  SeriesFunction f{splat(kBernoulli[4]), Vec{}, Vec{}};
  Vec u = f.c;
  Mat3 lower = apply_columns(f);
  for (int k = 3; k >= 0; --k) {
    multiply_by_square(f, u, theta_sq, sigma);
    f.c += kBernoulli[k];
    u += kBernoulli[k];
    // lower * hat(phi)^2 = (lower phi) phi^T - theta^2 lower
    const Mat3 squared = outer(lower * phi, phi) - theta_sq * lower;
    lower = squared + apply_columns(f);
  }
  k21 = splat(0.5) * p + lower;
  const Vec3 h = apply(f, phi, rho);
  k23 = splat(-0.5) * rho - (cross(phi, h) + sigma * h);
}

template <EdgeModel M>
FASTLOOP_INLINE Derivative derivative_of(const EdgeState& s) {
  using T = ModelTraits<M>;
  Derivative j;
  const Vec zero = {};
  if constexpr (T::kYaw) {
    const Mat3 r_from_world = transpose(rotation_matrix(s.q_from));
    const Vec3 g = r_from_world.c2, phi = s.e_rotation;
    const Vec theta_sq = dot(phi, phi);
    const Vec3 w = cross(phi, g);
    j.yaw = g - splat(0.5) * w + even_part(theta_sq, zero).b * cross(phi, w);
    j.b = r_from_world;
    j.d = s.t_to.x * r_from_world.c1 - s.t_to.y * r_from_world.c0;
    return j;
  }
  const Mat3 r_to_world = transpose(rotation_matrix(s.q_to));
  if constexpr (M == EdgeModel::kSe3) {
    const Vec half = s.q_error.w < 0.0 ? splat(-0.5) : splat(0.5);
    j.a = (half * (diagonal(s.q_error.w) + hat(s.q_error.v))) * r_to_world;
    j.b = rotation_matrix(s.q_error) * r_to_world;
    j.c = splat(-1.0) * (j.b * hat(s.t_to));
  }
  if constexpr (T::kLog) {
    const Vec3 phi = s.e_rotation;
    const Vec theta_sq = dot(phi, phi);
    SeriesFunction k11 = even_part(theta_sq, zero), k22 = even_part(theta_sq, s.e_scale);
    k11.c += 1.0;
    k11.a += 0.5;
    k22.c += 1.0 + 0.5 * s.e_scale;
    k22.a += 0.5;
    Mat3 k21;
    Vec3 k23;
    off_diagonal_blocks(s, theta_sq, k21, k23);
    j.a = matrix_of(k11, phi, theta_sq) * r_to_world;
    j.b = (1.0 / s.s_to) * (matrix_of(k22, phi, theta_sq) * r_to_world);
    j.c = k21 * r_to_world - j.b * hat(s.t_to);
    j.d = j.b * s.t_to + k23;
  }
  return j;
}

FASTLOOP_INLINE double* lanes_of(Vec& v) {
  return reinterpret_cast<double*>(&v);
}

/// Replaces one lane by the exact computation.
template <EdgeModel M>
static void exact_lane(const PassContext& ctx, const std::int32_t* from, const std::int32_t* to,
                       const double* z, int lane, EdgeState& s, Derivative* j) {
  using T = ModelTraits<M>;
  double measurement[8], e[7], jacobian[49];
  for (int f = 0; f < 8; ++f) measurement[f] = z[f * kLanes + lane];
  ctx.exact_edge(M, ctx.poses + static_cast<std::size_t>(from[lane]) * 8,
                 ctx.poses + static_cast<std::size_t>(to[lane]) * 8, measurement, e, jacobian);
  const auto set = [lane](Vec3& v, const double* x) {
    v.x[lane] = x[0];
    v.y[lane] = x[1];
    v.z[lane] = x[2];
  };
  const auto set_matrix = [&](Mat3& m, const double* x) {
    set(m.c0, x);
    set(m.c1, x + 7);
    set(m.c2, x + 14);
  };
  set(s.e_rotation, e);
  set(s.e_translation, e + 3);
  if constexpr (T::kLog) s.e_scale[lane] = e[6];
  if (j == nullptr) return;
  if constexpr (T::kYaw) {
    set(j->yaw, jacobian);
    set(j->d, jacobian + 3);
    set_matrix(j->b, jacobian + 7 + 3);
  } else {
    set_matrix(j->a, jacobian);
    set_matrix(j->c, jacobian + 3);
    set_matrix(j->b, jacobian + 3 * 7 + 3);
    if constexpr (T::kLog) set(j->d, jacobian + 6 * 7 + 3);
  }
}

FASTLOOP_INLINE bool any(VecMask m) {
  long long r = 0;
  for (int l = 0; l < kSimd; ++l) r |= m[l];
  return r != 0;
}

template <EdgeModel M>
FASTLOOP_INLINE void repair_far_lanes(const PassContext& ctx, const std::int32_t* from,
                                      const std::int32_t* to, const double* z, VecMask far,
                                      EdgeState& s, Derivative* j) {
  if (!any(far)) return;
  for (int l = 0; l < kSimd; ++l)
    if (far[l]) exact_lane<M>(ctx, from, to, z, l, s, j);
}

template <EdgeModel M>
FASTLOOP_INLINE void residual_array(const EdgeState& s, Vec* e) {
  e[0] = s.e_rotation.x;
  e[1] = s.e_rotation.y;
  e[2] = s.e_rotation.z;
  e[3] = s.e_translation.x;
  e[4] = s.e_translation.y;
  e[5] = s.e_translation.z;
  if constexpr (ModelTraits<M>::kLog) e[6] = s.e_scale;
}

/// weighted = information * e
template <int R>
FASTLOOP_INLINE void apply_information(const double* w, bool full, const Vec* e, Vec* weighted) {
  if (!full) {
    for (int i = 0; i < R; ++i) weighted[i] = load(w + i * kLanes) * e[i];
    return;
  }
  for (int i = 0; i < R; ++i) {
    Vec sum = {};
    for (int k = 0; k < R; ++k) {
      const int entry = i >= k ? i * (i + 1) / 2 + k : k * (k + 1) / 2 + i;
      sum += load(w + entry * kLanes) * e[k];
    }
    weighted[i] = sum;
  }
}

template <int R>
FASTLOOP_INLINE Vec inner(const Vec* a, const Vec* b) {
  Vec sum = a[0] * b[0];
  for (int i = 1; i < R; ++i) sum += a[i] * b[i];
  return sum;
}

/// Robust weight of every lane, 1 where no kernel applies.
FASTLOOP_INLINE Vec robust_weight(const PassContext& ctx, const double* robust, Vec squared,
                                  Vec* cost) {
  Vec weight = splat(1.0), rho = squared;
  if (ctx.robust_kernel != 0) {
    for (int l = 0; l < kSimd; ++l) {
      if (robust[l] == 0) continue;
      double c, w;
      ctx.exact_robust(ctx.robust_kernel, ctx.robust_width, squared[l], &c, &w);
      rho[l] = c;
      weight[l] = w;
    }
  }
  if (cost) *cost = rho;
  return weight;
}

/// Dense columns of the derivative; zero blocks are written out.
template <EdgeModel M>
FASTLOOP_INLINE void dense_derivative(const Derivative& j, Vec (*column)[7]) {
  using T = ModelTraits<M>;
  const auto put = [](Vec* to, Vec3 v) {
    to[0] = v.x;
    to[1] = v.y;
    to[2] = v.z;
  };
  for (int c = 0; c < T::kTangent; ++c)
    for (int r = 0; r < 7; ++r) column[c][r] = Vec{};
  if constexpr (T::kYaw) {
    put(column[0], j.yaw);
    put(column[0] + 3, j.d);
    put(column[1] + 3, j.b.c0);
    put(column[2] + 3, j.b.c1);
    put(column[3] + 3, j.b.c2);
  } else {
    put(column[0], j.a.c0);
    put(column[1], j.a.c1);
    put(column[2], j.a.c2);
    put(column[0] + 3, j.c.c0);
    put(column[1] + 3, j.c.c1);
    put(column[2] + 3, j.c.c2);
    put(column[3] + 3, j.b.c0);
    put(column[4] + 3, j.b.c1);
    put(column[5] + 3, j.b.c2);
    if constexpr (M == EdgeModel::kSim3) {
      put(column[6] + 3, j.d);
      column[6][6] = splat(1.0);
    }
  }
}

/// Is entry (row, column) of the derivative zero by structure?
template <EdgeModel M>
constexpr bool is_zero(int row, int column) {
  if (ModelTraits<M>::kYaw) return row < 3 && column > 0;
  if (row < 3) return column >= 3;
  if (row < 6) return false;
  return M != EdgeModel::kSim3 || column < 6;
}

/// hessian = J^T W J (packed lower triangle), gradient = J^T W e, both times the robust weight.
template <EdgeModel M>
FASTLOOP_INLINE void normal_equations(const Vec (*column)[7], const Vec* weighted_residual,
                                      const double* information, bool full, Vec robust,
                                      double* hessian, double* gradient) {
  using T = ModelTraits<M>;
  constexpr int kD = T::kTangent, kR = T::kResidual;
  for (int c = 0; c < kD; ++c) {
    Vec sum = {};
    for (int r = 0; r < kR; ++r)
      if (!is_zero<M>(r, c)) sum += column[c][r] * weighted_residual[r];
    store(gradient + c * kLanes, robust * sum);
    if (hessian == nullptr) continue;
    Vec weighted[7];
    apply_information<kR>(information, full, column[c], weighted);
    for (int k = 0; k < kR; ++k) weighted[k] *= robust;
    for (int other = c; other < kD; ++other) {
      Vec h = {};
      for (int r = 0; r < kR; ++r)
        if (!is_zero<M>(r, other) && (full || !is_zero<M>(r, c)))
          h += column[other][r] * weighted[r];
      store(hessian + (other * (other + 1) / 2 + c) * kLanes, h);
    }
  }
}

template <EdgeModel M, bool kWithHessian>
static void linearize_batch(const PassContext& ctx, BatchCursor& cursor, std::ptrdiff_t batch) {
  using T = ModelTraits<M>;
  const EdgeBatches& edges = ctx.edges;
  const double* information = edges.information + edges.information_offset[batch];
  const bool full = edges.full_information[batch] != 0;
  for (int first = 0; first < kLanes; first += kSimd) {
    const std::int32_t* from = edges.from + batch * kLanes + first;
    const std::int32_t* to = edges.to + batch * kLanes + first;
    const double* z = edges.measurement + batch * 8 * kLanes + first;
    VecMask far = {};
    EdgeState s = residual_of<M>(ctx, from, to, z, far);
    Derivative j = derivative_of<M>(s);
    repair_far_lanes<M>(ctx, from, to, z, far, s, &j);
    Vec e[7], weighted[7], column[T::kTangent][7];
    residual_array<M>(s, e);
    apply_information<T::kResidual>(information + first, full, e, weighted);
    const Vec robust = robust_weight(ctx, edges.robust + batch * kLanes + first,
                                     inner<T::kResidual>(e, weighted), nullptr);
    dense_derivative<M>(j, column);
    double* hessian = kWithHessian ? cursor.hessian + first : nullptr;
    if (full) {
      normal_equations<M>(column, weighted, information + first, true, robust, hessian,
                          cursor.gradient + first);
    } else {
      normal_equations<M>(column, weighted, information + first, false, robust, hessian,
                          cursor.gradient + first);
    }
  }
  cursor.batch = batch;
}

template <EdgeModel M>
static void linearize_full(const PassContext& ctx, BatchCursor& cursor, std::ptrdiff_t batch) {
  linearize_batch<M, true>(ctx, cursor, batch);
}

template <EdgeModel M>
static double cost_of_batches(const PassContext& ctx, std::size_t begin, std::size_t end,
                              double* squared_out) {
  using T = ModelTraits<M>;
  const EdgeBatches& edges = ctx.edges;
  double total = 0;
  for (std::size_t batch = begin; batch < end; ++batch) {
    const double* information = edges.information + edges.information_offset[batch];
    const bool full = edges.full_information[batch] != 0;
    double sum = 0;
    for (int first = 0; first < kLanes; first += kSimd) {
      const std::int32_t* from = edges.from + batch * kLanes + first;
      const std::int32_t* to = edges.to + batch * kLanes + first;
      const double* z = edges.measurement + batch * 8 * kLanes + first;
      VecMask far = {};
      EdgeState s = residual_of<M>(ctx, from, to, z, far);
      repair_far_lanes<M>(ctx, from, to, z, far, s, nullptr);
      Vec e[7], weighted[7], cost;
      residual_array<M>(s, e);
      apply_information<T::kResidual>(information + first, full, e, weighted);
      const Vec squared = inner<T::kResidual>(e, weighted);
      robust_weight(ctx, edges.robust + batch * kLanes + first, squared, &cost);
      if (squared_out) store(squared_out + batch * kLanes + first, squared);
      for (int l = 0; l < kSimd; ++l) sum += cost[l];
    }
    total += sum;
  }
  return total;
}
