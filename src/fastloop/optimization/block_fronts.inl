// Dense partial Cholesky of a front, assembly, and the two triangular solves. Matrices are
// column-major, lower triangle; what lies above the diagonal is scratch and may hold anything
// finite or not, nothing reads it.

constexpr int kTileColumns = FASTLOOP_TILE_COLUMNS;
constexpr int kTileVectors = FASTLOOP_TILE_VECTORS;

/// acc -= rows of `a` times rows of `b`, over `depth` columns of stride `stride`.
template <int MV, int NR>
FASTLOOP_INLINE void subtract_product(const double* a, const double* b, std::ptrdiff_t stride,
                                      int depth, Vec (&acc)[NR][MV]) {
  for (int k = 0; k < depth; ++k, a += stride, b += stride) {
    Vec x[MV];
    for (int m = 0; m < MV; ++m) x[m] = load(a + m * kSimd);
    for (int n = 0; n < NR; ++n) {
      const Vec s = splat(b[n]);
      for (int m = 0; m < MV; ++m) acc[n][m] -= x[m] * s;
    }
  }
}

/// Columns [j, j + NR) of the update matrix, rows from `i` on, MV vectors.
template <int MV, int NR>
FASTLOOP_INLINE void update_tile(const double* panel, std::ptrdiff_t stride, int pivots, int i,
                                 int j, double* column, std::ptrdiff_t schur_stride) {
  Vec acc[NR][MV];
  for (int n = 0; n < NR; ++n)
    for (int m = 0; m < MV; ++m) acc[n][m] = load(column + n * schur_stride + m * kSimd);
  subtract_product<MV, NR>(panel + i, panel + j, stride, pivots, acc);
  for (int n = 0; n < NR; ++n)
    for (int m = 0; m < MV; ++m) store(column + n * schur_stride + m * kSimd, acc[n][m]);
}

/// The same for all rows down to `rows` (a multiple of kRowAlign).
template <int NR>
static void update_columns(const double* panel, std::ptrdiff_t stride, int pivots, int rows, int j,
                           double* column, int first_row, std::ptrdiff_t schur_stride) {
  int i = j / kSimd * kSimd;
  double* c = column - first_row;
  for (; i + kTileVectors * kSimd <= rows; i += kTileVectors * kSimd)
    update_tile<kTileVectors, NR>(panel, stride, pivots, i, j, c + i, schur_stride);
  if constexpr (kTileVectors > 2) {
    for (; i + 2 * kSimd <= rows; i += 2 * kSimd)
      update_tile<2, NR>(panel, stride, pivots, i, j, c + i, schur_stride);
  }
  for (; i < rows; i += kSimd) update_tile<1, NR>(panel, stride, pivots, i, j, c + i, schur_stride);
}

/// Rows [i, i + MV vectors) of panel columns [j, j + NR): left-looking update, then division by the
/// diagonal block `l` (NR x NR, inverted diagonal).
template <int MV, int NR>
FASTLOOP_INLINE void solve_tile(double* panel, std::ptrdiff_t stride, int i, int j,
                                const double (&l)[kTileColumns][kTileColumns]) {
  Vec acc[NR][MV];
  double* c = panel + j * stride + i;
  for (int n = 0; n < NR; ++n)
    for (int m = 0; m < MV; ++m) acc[n][m] = load(c + n * stride + m * kSimd);
  subtract_product<MV, NR>(panel + i, panel + j, stride, j, acc);
  for (int n = 0; n < NR; ++n) {
    const Vec inverse = splat(l[n][n]);
    for (int m = 0; m < MV; ++m) acc[n][m] *= inverse;
    for (int o = n + 1; o < NR; ++o) {
      const Vec s = splat(l[o][n]);
      for (int m = 0; m < MV; ++m) acc[o][m] -= acc[n][m] * s;
    }
  }
  for (int n = 0; n < NR; ++n)
    for (int m = 0; m < MV; ++m) store(c + n * stride + m * kSimd, acc[n][m]);
}

/// Cholesky of the diagonal block at j after the left-looking update; l gets the factor with
/// inverted diagonal.
template <int NR>
FASTLOOP_INLINE bool factor_diagonal(const double* panel, std::ptrdiff_t stride, int j,
                                     double (&l)[kTileColumns][kTileColumns]) {
  double a[NR][NR];
  for (int c = 0; c < NR; ++c)
    for (int r = c; r < NR; ++r) a[r][c] = panel[(j + c) * stride + j + r];
  for (int k = 0; k < j; ++k) {
    const double* p = panel + k * stride + j;
    for (int c = 0; c < NR; ++c)
      for (int r = c; r < NR; ++r) a[r][c] -= p[r] * p[c];
  }
  for (int c = 0; c < NR; ++c) {
    const double pivot = a[c][c];
    if (!(pivot > 1e-300 && pivot < 1e300)) return false;
    const double inverse = 1.0 / __builtin_sqrt(pivot);
    l[c][c] = inverse;
    for (int r = c + 1; r < NR; ++r) l[r][c] = a[r][c] *= inverse;
    for (int o = c + 1; o < NR; ++o)
      for (int r = o; r < NR; ++r) a[r][o] -= a[r][c] * a[o][c];
  }
  return true;
}

template <int NR>
static bool factor_panel_columns(double* panel, std::ptrdiff_t stride, int rows, int j) {
  double l[kTileColumns][kTileColumns];
  if (!factor_diagonal<NR>(panel, stride, j, l)) return false;
  int i = j / kSimd * kSimd;
  for (; i + kTileVectors * kSimd <= rows; i += kTileVectors * kSimd)
    solve_tile<kTileVectors, NR>(panel, stride, i, j, l);
  for (; i < rows; i += kSimd) solve_tile<1, NR>(panel, stride, i, j, l);
  for (int n = 0; n < NR; ++n) panel[(j + n) * stride + j + n] = l[n][n];
  return true;
}

/// Calls f.template operator()<NR>(j) over [begin, end) in tiles of kTileColumns and a narrower
/// last one.
template <class F>
FASTLOOP_INLINE bool for_column_tiles(int begin, int end, F f) {
  int j = begin;
  for (; j + kTileColumns <= end; j += kTileColumns)
    if (!f.template operator()<kTileColumns>(j)) return false;
  switch (end - j) {
    case 1:
      return f.template operator()<1>(j);
    case 2:
      return f.template operator()<2>(j);
    case 3:
      return f.template operator()<3>(j);
    case 4:
      return kTileColumns > 4 ? f.template operator()<4>(j) : true;
    case 5:
      return kTileColumns > 4 ? f.template operator() < 5 <= kTileColumns ? 5 : 1 > (j) : true;
    case 6:
      return kTileColumns > 4 ? f.template operator() < 6 <= kTileColumns ? 6 : 1 > (j) : true;
    case 7:
      return kTileColumns > 4 ? f.template operator() < 7 <= kTileColumns ? 7 : 1 > (j) : true;
    default:
      return true;
  }
}

/// Panel and update matrix of an assembled front.
template <int D>
static bool eliminate(const FrontView& f) {
  const int pivots = f.pivots * D, columns = (f.pivots + f.below) * D;
  const int rows = f.panel_stride;
  // With 7 unknowns a tile of one vertex keeps all tiles whole; otherwise tiles run over vertex
  // borders.
  const bool ok = for_column_tiles(0, pivots, [&]<int NR>(int j) {
    return factor_panel_columns<NR>(f.panel, f.panel_stride, rows, j);
  });
  if (!ok) return false;
  for_column_tiles(pivots, columns, [&]<int NR>(int j) {
    update_columns<NR>(f.panel, f.panel_stride, pivots, rows, j,
                       f.schur + static_cast<std::ptrdiff_t>(j - pivots) * f.schur_stride,
                       f.schur_first_row, f.schur_stride);
    return true;
  });
  return true;
}

FASTLOOP_INLINE void set_zero(double* p, std::size_t n) {
  __builtin_memset(p, 0, n * sizeof(double));
}

/// The same for a short column, whose length is a multiple of the vector's: a call would cost more
/// than the work.
FASTLOOP_INLINE void set_column_zero(double* p, std::size_t n) {
  for (std::size_t i = 0; i < n; i += kSimd) {
    store(p + i, Vec{});
    asm volatile("");  // keeps the compiler from turning the loop into that call
  }
}

/// Address of (row, column) of the front.
template <int D>
FASTLOOP_INLINE double* front_column(const FrontView& f, int block, std::ptrdiff_t& stride) {
  if (block < f.pivots) {
    stride = f.panel_stride;
    return f.panel + static_cast<std::ptrdiff_t>(block) * D * f.panel_stride;
  }
  stride = f.schur_stride;
  return f.schur + static_cast<std::ptrdiff_t>(block - f.pivots) * D * f.schur_stride -
         f.schur_first_row;
}

/// to[0..n) += from[0..n)
FASTLOOP_INLINE void add_run(double* to, const double* from, int n) {
  int i = 0;
  for (; i + kSimd <= n; i += kSimd) store(to + i, load(to + i) + load(from + i));
  for (; i < n; ++i) to[i] += from[i];
}

template <int D>
static void add_child(const FrontView& f, const ChildView& child, const double* scratch) {
  const double* schur = (child.schur != nullptr ? child.schur : scratch) + child.schur_offset;
  const int rhs_row = (f.pivots + f.below) * D, child_rhs_row = child.blocks * D;
  int run = 0;
  for (int j = 0; j < child.blocks; ++j) {
    while (child.runs[run].first + child.runs[run].count <= j) ++run;
    std::ptrdiff_t stride;
    double* to = front_column<D>(f, child.position[j], stride);
    const double* from = schur + static_cast<std::ptrdiff_t>(j) * D * child.stride;
    for (int r = run; r < child.num_runs; ++r) {
      const int first = child.runs[r].first > j ? child.runs[r].first : j;
      const int n = (child.runs[r].first + child.runs[r].count - first) * D;
      double* t = to + child.position[first] * D;
      const double* s = from + first * D;
      for (int c = 0; c < D; ++c) add_run(t + c * stride, s + c * child.stride, n);
    }
    for (int c = 0; c < D; ++c) to[c * stride + rhs_row] += from[c * child.stride + child_rhs_row];
  }
}

/// Adds sign * H of one edge lane at block (row, column), row >= column in the front.
template <int D, bool kDiagonal>
FASTLOOP_INLINE void add_hessian(double* to, std::ptrdiff_t stride, const double* h) {
  for (int c = 0; c < D; ++c) {
    double* t = to + c * stride;
    for (int r = kDiagonal ? c : 0; r < D; ++r) {
      const double value = h[(r >= c ? r * (r + 1) / 2 + c : c * (c + 1) / 2 + r) * kLanes];
      if constexpr (kDiagonal) {
        t[r] += value;
      } else {
        t[r] -= value;
      }
    }
  }
}

template <int D>
FASTLOOP_INLINE void add_edge(const FrontView& f, const std::int32_t* position,
                              const double* hessian, const double* gradient) {
  const int rhs_row = (f.pivots + f.below) * D;
  for (int end = 0; end < 2; ++end) {
    const int block = position[end];
    if (block < 0) continue;
    std::ptrdiff_t stride;
    double* column = front_column<D>(f, block, stride);
    add_hessian<D, true>(column + block * D, stride, hessian);
    for (int c = 0; c < D; ++c) {
      const double g = gradient[c * kLanes];
      column[c * stride + rhs_row] += end == 0 ? g : -g;
    }
  }
  if (position[0] < 0 || position[1] < 0) return;
  const int low = position[0] < position[1] ? position[0] : position[1];
  const int high = position[0] < position[1] ? position[1] : position[0];
  std::ptrdiff_t stride;
  double* column = front_column<D>(f, low, stride);
  add_hessian<D, false>(column + high * D, stride, hessian);
}

template <int D>
static void add_damping(const PassContext& ctx, const FrontView& f) {
  for (int p = 0; p < f.pivots; ++p) {
    const double* metric = ctx.damping + static_cast<std::size_t>(f.first_vertex + p) * 28;
    double* t = f.panel + static_cast<std::ptrdiff_t>(p) * D * f.panel_stride + p * D;
    for (int c = 0; c < D; ++c)
      for (int r = c; r < D; ++r)
        t[c * f.panel_stride + r] += ctx.lambda * metric[r * (r + 1) / 2 + c];
  }
}

template <EdgeModel M>
static bool factor_front(const PassContext& ctx, const FrontView& front, BatchCursor& cursor,
                         double* scratch) {
  FrontView f = front;
  if (f.schur == nullptr) f.schur = scratch + f.schur_offset;
  constexpr int D = ModelTraits<M>::kTangent;
  set_zero(f.panel, static_cast<std::size_t>(f.panel_stride) * f.pivots * D);
  for (int j = 0; j < f.below * D; ++j) {
    const int row = (f.pivots * D + j) / kSimd * kSimd - f.schur_first_row;
    set_column_zero(f.schur + static_cast<std::ptrdiff_t>(j) * f.schur_stride + row,
                    static_cast<std::size_t>(f.schur_stride - row));
  }
  for (std::size_t slot = f.edges_begin; slot < f.edges_end; ++slot) {
    const std::ptrdiff_t batch = static_cast<std::ptrdiff_t>(slot / kLanes);
    if (batch != cursor.batch) linearize_batch<M, true>(ctx, cursor, batch);
    const int lane = slot % kLanes;
    add_edge<D>(f, f.edge_position + 2 * slot, cursor.hessian + lane, cursor.gradient + lane);
  }
  for (int c = 0; c < f.num_children; ++c) add_child<D>(f, f.children[c], scratch);
  if (ctx.lambda > 0) add_damping<D>(ctx, f);
  return eliminate<D>(f);
}

/// Asks for memory ahead of the triangular solves: panels lie in the order in which they are read,
/// but the hardware loses track at every page and when columns are taken in falling order.
/// Addresses outside the buffer do no harm.
FASTLOOP_INLINE void prefetch_columns(const double* column, std::ptrdiff_t doubles,
                                      std::ptrdiff_t ahead) {
  const char* p = reinterpret_cast<const char*>(column + ahead);
  for (std::ptrdiff_t i = 0; i < doubles; i += kRowAlign)
    __builtin_prefetch(p + i * sizeof(double), 0, 2);
}
constexpr std::ptrdiff_t kPrefetchDoubles = 1024;

template <EdgeModel M>
static void forward_front(const PassContext& ctx, const FrontView& f, BatchCursor& cursor,
                          double* b) {
  constexpr int D = ModelTraits<M>::kTangent;
  const int pivots = f.pivots * D, rows = (f.pivots + f.below) * D;
  set_zero(b, static_cast<std::size_t>(rows));
  for (std::size_t slot = f.edges_begin; slot < f.edges_end; ++slot) {
    const std::ptrdiff_t batch = static_cast<std::ptrdiff_t>(slot / kLanes);
    if (batch != cursor.batch) linearize_batch<M, false>(ctx, cursor, batch);
    const double* g = cursor.gradient + slot % kLanes;
    const std::int32_t* position = f.edge_position + 2 * slot;
    for (int end = 0; end < 2; ++end) {
      if (position[end] < 0) continue;
      for (int c = 0; c < D; ++c)
        b[position[end] * D + c] += end == 0 ? g[c * kLanes] : -g[c * kLanes];
    }
  }
  for (int k = 0; k < f.num_children; ++k) {
    const ChildView& child = f.children[k];
    for (int j = 0; j < child.blocks; ++j)
      for (int c = 0; c < D; ++c) b[child.position[j] * D + c] += child.rhs[j * D + c];
  }
  for (int j = 0; j < pivots; ++j) {
    double* l = f.panel + static_cast<std::ptrdiff_t>(j) * f.panel_stride;
    prefetch_columns(l, f.panel_stride, kPrefetchDoubles);
    const double y = b[j] * l[j];
    l[rows] = y;
    int i = j + 1;
    const Vec s = splat(y);
    for (; i + kSimd <= rows; i += kSimd) store(b + i, load(b + i) - load(l + i) * s);
    for (; i < rows; ++i) b[i] -= l[i] * y;
  }
  for (int j = 0; j < f.below * D; ++j) f.rhs[j] = b[pivots + j];
}

/// Columns [j, j + NR): x_j = (y_j - sum over rows below of L x) / L_jj, given x of all rows below
/// the tile.
template <int NR>
FASTLOOP_INLINE void backward_columns(const FrontView& f, int rows, int j, double* x) {
  const double* l = f.panel + static_cast<std::ptrdiff_t>(j) * f.panel_stride;
  Vec acc[NR] = {};
  double sum[NR];
  int i = j + NR;
  for (; i + kSimd <= rows; i += kSimd) {
    const Vec v = load(x + i);
    for (int n = 0; n < NR; ++n) acc[n] += v * load(l + n * f.panel_stride + i);
  }
  for (int n = 0; n < NR; ++n) {
    sum[n] = l[n * f.panel_stride + rows];
    for (int k = 0; k < kSimd; ++k) sum[n] -= acc[n][k];
  }
  for (; i < rows; ++i)
    for (int n = 0; n < NR; ++n) sum[n] -= x[i] * l[n * f.panel_stride + i];
  for (int n = NR - 1; n >= 0; --n) {
    for (int k = n + 1; k < NR; ++k) sum[n] -= x[j + k] * l[n * f.panel_stride + j + k];
    x[j + n] = sum[n] * l[n * f.panel_stride + j + n];
  }
}

template <EdgeModel M>
static double backward_front(const FrontView& f, double* x) {
  constexpr int D = ModelTraits<M>::kTangent;
  const int rows = (f.pivots + f.below) * D;
  double squared_norm = 0;
  for (int c = 0; c < f.pivots * D; ++c) {
    const double y = f.panel[static_cast<std::ptrdiff_t>(c) * f.panel_stride + rows];
    squared_norm += y * y;
  }
  int j = f.pivots * D;
  for (; j >= 4; j -= 4) {
    prefetch_columns(f.panel + static_cast<std::ptrdiff_t>(j - 4) * f.panel_stride,
                     4 * f.panel_stride, -kPrefetchDoubles);
    backward_columns<4>(f, rows, j - 4, x);
  }
  for (; j >= 1; --j) backward_columns<1>(f, rows, j - 1, x);
  return squared_norm;
}

template <EdgeModel M>
static ModelKernels kernels_of() {
  return {factor_front<M>, forward_front<M>, backward_front<M>, cost_of_batches<M>,
          linearize_full<M>};
}

static KernelSet make_kernel_set(const char* name) {
  return {name,
          {kernels_of<EdgeModel::kYaw>(), kernels_of<EdgeModel::kSe3>(),
           kernels_of<EdgeModel::kSim3>(), kernels_of<EdgeModel::kSim3FixedScale>()}};
}
