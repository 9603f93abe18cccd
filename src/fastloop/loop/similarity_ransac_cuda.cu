#include <algorithm>
#include <cstring>

#include "fastloop/compute/cuda_call.cuh"
#include "fastloop/loop/similarity_ransac_cuda.hpp"

namespace fastloop::loop {
namespace {

constexpr int kWarp = 32;
constexpr int kWarpsPerBlock = 4;

/// A problem in device memory and where the counts of its hypotheses go.
struct DeviceProblem {
  PairArrays pairs;
  int begin, end;
  int* counts;
};

/// One warp for each hypothesis: every lane makes it, which costs nothing extra, and looks at every
/// 32nd pair. blockIdx.y is the problem.
__global__ void count_inliers_kernel(matching::CameraView camera, std::uint64_t seed,
                                     bool fixed_scale, const DeviceProblem* problems) {
  const DeviceProblem problem = problems[blockIdx.y];
  const int lane = threadIdx.x % kWarp;
  const int h = problem.begin + static_cast<int>(blockIdx.x) * kWarpsPerBlock +
                static_cast<int>(threadIdx.x) / kWarp;
  if (h >= problem.end) return;
  SimilarityF s;
  int count = 0;
  if (make_hypothesis(problem.pairs, seed, h, fixed_scale, &s))
    for (int i = lane; i < problem.pairs.size; i += kWarp)
      count += is_inlier(camera, problem.pairs, s, i);
  count = __reduce_add_sync(0xffffffffu, count);
  if (lane == 0) problem.counts[h - problem.begin] = count;
}

/// Lays arrays one after another into the staging buffer and says where they will be on the device.
class Packer {
 public:
  Packer(std::byte* host, std::byte* device) : host_(host), device_(device) {}
  template <class T>
  const T* put(const T* from, std::size_t n) {
    const T* at = reinterpret_cast<const T*>(device_ + used_);
    std::memcpy(host_ + used_, from, n * sizeof(T));
    used_ += (n * sizeof(T) + 15) / 16 * 16;
    return at;
  }
  std::size_t used() const { return used_; }

 private:
  std::byte *host_, *device_;
  std::size_t used_ = 0;
};

PairArrays put(Packer& packer, const PairArrays& p) {
  const auto n = static_cast<std::size_t>(p.size);
  PairArrays d = p;
  d.p_first = packer.put(p.p_first, 3 * n);
  d.pixel_first = packer.put(p.pixel_first, 2 * n);
  d.gate_first = packer.put(p.gate_first, n);
  d.p_second = packer.put(p.p_second, 3 * n);
  d.view = packer.put(p.view, n);
  d.pixel_view = packer.put(p.pixel_view, 2 * n);
  d.gate_view = packer.put(p.gate_view, n);
  d.views = packer.put(p.views, static_cast<std::size_t>(p.num_views));
  return d;
}

std::size_t bytes_of(const PairArrays& p) {
  return 13 * sizeof(float) * static_cast<std::size_t>(p.size) +
         sizeof(ViewPose) * static_cast<std::size_t>(p.num_views) + 8 * 16;
}

void count_all(CudaSession& session, const matching::CameraView& camera, std::uint64_t seed,
               bool fixed_scale, std::span<HypothesisRange> ranges) {
  const CudaRange range("similarity");
  CudaSession::Impl& cuda = session.impl();
  cuda.use();
  const auto memory = session.part<CudaCallMemory>();
  CudaWaitOnFailure wait(cuda);
  std::size_t bytes = ranges.size() * sizeof(DeviceProblem) + 16, total = 0;
  int most = 0;
  for (const HypothesisRange& r : ranges) {
    bytes += bytes_of(r.pairs);
    total += static_cast<std::size_t>(r.end - r.begin);
    most = std::max(most, r.end - r.begin);
  }
  memory->staging.reserve(cuda, bytes);
  memory->input.reserve(cuda, bytes);
  memory->output.reserve(cuda, total * sizeof(int));
  memory->results.reserve(cuda, total * sizeof(int));

  Packer packer(memory->staging.data(), memory->input.data());
  std::vector<DeviceProblem> problems;
  int* counts = reinterpret_cast<int*>(memory->output.data());
  for (const HypothesisRange& r : ranges) {
    problems.push_back({put(packer, r.pairs), r.begin, r.end, counts});
    counts += r.end - r.begin;
  }
  const DeviceProblem* on_device = packer.put(problems.data(), problems.size());
  cuda.to_device(memory->input.data(), memory->staging.data(), packer.used());
  const dim3 grid((static_cast<unsigned>(most) + kWarpsPerBlock - 1) / kWarpsPerBlock,
                  static_cast<unsigned>(problems.size()));
  count_inliers_kernel<<<grid, kWarp * kWarpsPerBlock, 0, cuda.stream>>>(camera, seed, fixed_scale,
                                                                         on_device);
  cuda.launched("count_inliers_kernel");
  cuda.to_host(memory->results.data(), memory->output.data(), total * sizeof(int));
  cuda.synchronize();
  wait.disarm();
  const int* from = reinterpret_cast<const int*>(memory->results.data());
  for (HypothesisRange& r : ranges) {
    r.counts.assign(from, from + (r.end - r.begin));
    from += r.end - r.begin;
  }
}

}  // namespace

bool count_inliers_cuda(CudaSession& session, const matching::CameraView& camera,
                        std::uint64_t seed, bool fixed_scale, std::span<HypothesisRange> ranges) {
  const std::lock_guard lock(session.mutex());
  if (!session.usable()) return false;
  if (ranges.empty()) return true;
  try {
    count_all(session, camera, seed, fixed_scale, ranges);
    return true;
  } catch (const CudaError& e) {
    session.report_failure("similarity", e.what());
    return false;
  }
}

}  // namespace fastloop::loop
