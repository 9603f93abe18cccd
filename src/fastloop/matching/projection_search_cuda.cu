#include "fastloop/matching/projection_search_cuda.hpp"

#include <algorithm>
#include <cstring>
#include <unordered_map>

#include "fastloop/compute/cuda_call.cuh"
#include "fastloop/matching/device_scan.cuh"

namespace fastloop::matching {
namespace {

constexpr int kThreads = 128;
constexpr int kLanes = 8;  // that share a window

/// A target as the kernel reads it; pointers on the device, or page-locked where they say host.
struct DeviceTarget {
  TargetView view;  ///< without features
  PackedView features;
  const std::uint8_t* blocked;
  LandmarkArrays landmarks;
  int num_landmarks;
  /// Distance << 32 | landmark of the best claim on each keypoint; all bits set before and after.
  unsigned long long* winner;
  unsigned* finished;              ///< blocks that are through with the target; 0 before and after
  std::uint32_t* in_view;          ///< null: nobody asks
  std::uint32_t* host_in_view;
  KeypointMatch* host_matches;     ///< [keypoints]
  std::uint32_t* host_num_matches;
};

/// Where the kernel finds the targets: few come with the launch, many lie in memory.
struct FewTargets {
  static constexpr std::size_t kMost = 8;
  DeviceTarget target[kMost];
  __device__ const DeviceTarget& operator[](unsigned t) const { return target[t]; }
};
struct ManyTargets {
  const DeviceTarget* target;
  __device__ const DeviceTarget& operator[](unsigned t) const { return target[t]; }
};

/// A landmark that passed the gates.
struct Seen {
  int landmark;
  Sighting sighting;
};

/// The gates, a thread for each of `chunk` landmarks; collects those in view in shared memory.
__device__ void collect_seen(const ProjectionRule& rule, const DeviceTarget& target, int first,
                             int chunk, Seen* seen, int* num_seen) {
  if (static_cast<int>(threadIdx.x) >= chunk) return;  // whole warps
  const int i = first + static_cast<int>(threadIdx.x);
  const unsigned lane = threadIdx.x % 32;
  Sighting sighting;
  const std::uint8_t* skipped = target.view.landmark_skipped;
  if (i < target.num_landmarks) {
    // Gates ask for these one after another, the scan for the descriptor: all on the way at once.
    prefetch(target.landmarks.max_distance_m + i);
    prefetch(target.landmarks.min_distance_m + i);
    prefetch(target.landmarks.normal_world + 3 * static_cast<std::size_t>(i));
    prefetch(target.landmarks.descriptor + i);
  }
  const bool passed = i < target.num_landmarks && !(skipped && skipped[i]) &&
                      sight(rule, target.view, target.landmarks, i, &sighting);
  const unsigned votes = __ballot_sync(~0u, passed);
  int place = 0;
  if (lane == 0) {
    if (target.in_view && i < target.num_landmarks) target.in_view[i / 32] = votes;
    place = atomicAdd(num_seen, __popc(votes));
  }
  place = __shfl_sync(~0u, place, 0) + __popc(votes & ((1u << lane) - 1));
  if (passed) seen[place] = {i, sighting};
}

/// Writes what was found in a target to the host, and leaves its memory as it was before.
__device__ void report(const DeviceTarget& target) {
  const auto write = [&](int place, int k, unsigned long long winner) {
    target.host_matches[place] = {static_cast<std::uint32_t>(winner), static_cast<std::uint16_t>(k),
                                  static_cast<std::uint16_t>(winner >> 32)};
  };
  const int written = take_claims<kThreads>(target.winner, target.features.size, write);
  if (target.in_view)
    for (int w = static_cast<int>(threadIdx.x); w < (target.num_landmarks + 31) / 32; w += kThreads)
      target.host_in_view[w] = __ldcg(target.in_view + w);
  if (threadIdx.x != 0) return;
  *target.host_num_matches = static_cast<std::uint32_t>(written);
  *target.finished = 0;
}

/// A block looks at `chunk` landmarks (a multiple of 32, at most kThreads) in one target: first a
/// thread for each, then, for those that are in view, several lanes each, which share the rows of
/// the window. The last block of a target reports it.
template <class Targets>
__global__ void __launch_bounds__(kThreads)
    search_kernel(const __grid_constant__ ProjectionRule rule,
                  const __grid_constant__ Targets targets, int chunk, unsigned chunks) {
  __shared__ Seen seen[kThreads];
  __shared__ int num_seen;
  __shared__ bool last;
  const DeviceTarget& target = targets[blockIdx.x / chunks];
  const int first = static_cast<int>(blockIdx.x % chunks) * chunk;
  if (first >= target.num_landmarks) return;
  if (threadIdx.x == 0) num_seen = 0;
  __syncthreads();
  collect_seen(rule, target, first, chunk, seen, &num_seen);
  __syncthreads();
  const int lane = static_cast<int>(threadIdx.x) % kLanes;
  const int end = target.features.size > 0 ? num_seen : 0;
  for (int s = static_cast<int>(threadIdx.x) / kLanes; s < end; s += kThreads / kLanes) {
    const int i = seen[s].landmark;
    const WindowScan w = window_of(rule, target.view, target.landmarks, i, seen[s].sighting);
    const DeviceDistance distance(target.landmarks.descriptor + i, target.features.descriptors);
    const BestTwo found = merged<kLanes>(
        scan_rows(target.features, target.blocked, rule.scales, w, distance, lane, kLanes));
    if (lane != 0) continue;
    const MatchKey key = best_of(target.features, w, found);
    if (key != kNoKey)
      atomicMin(target.winner + key_index(key),
                static_cast<unsigned long long>(key_distance(key)) << 32 | static_cast<unsigned>(i));
  }
  __threadfence();  // claims are there before the block counts as finished
  __syncthreads();
  if (threadIdx.x == 0) {
    const auto blocks = static_cast<unsigned>((target.num_landmarks + chunk - 1) / chunk);
    last = atomicAdd(target.finished, 1u) + 1 == blocks;
    __threadfence();
  }
  __syncthreads();
  if (last) report(target);
}

/// What searches keep on the device from call to call, a part of the session.
struct SearchMemory {
  explicit SearchMemory(CudaSession&) {}
  DeviceBuffer<unsigned long long> winner;
  DeviceBuffer<unsigned> finished;
  DeviceBuffer<std::uint32_t> in_view;
  bool clean = false;  ///< winner and finished are as a search expects them
  DeviceBuffer<float> scales;
  std::vector<float> known_scales;  ///< what `scales` holds
  PinnedBuffer<float> scales_staging;

  void prepare(CudaSession::Impl& cuda, std::size_t winners, std::size_t targets,
               std::size_t words) {
    if (winners > winner.capacity() || targets > finished.capacity()) clean = false;
    winner.reserve(cuda, winners);
    finished.reserve(cuda, targets);
    in_view.reserve(cuda, words);
    if (!clean && winner.capacity() > 0)
      cuda.check(cudaMemsetAsync(winner.data(), 0xff,
                                 winner.capacity() * sizeof(unsigned long long), cuda.stream),
                 "cudaMemsetAsync");
    if (!clean) cuda.clear(finished.data(), finished.capacity() * sizeof(unsigned));
    clean = true;
  }

  /// The pyramid on the device; it hardly ever changes.
  ScaleView put(CudaSession::Impl& cuda, const ScaleView& s) {
    const auto levels = static_cast<std::size_t>(s.levels);
    std::vector<float> wanted(s.scale, s.scale + levels);
    wanted.insert(wanted.end(), s.sigma2, s.sigma2 + levels);
    if (wanted != known_scales) {
      known_scales.clear();
      scales.reserve(cuda, wanted.size());
      scales_staging.reserve(cuda, wanted.size());
      std::copy(wanted.begin(), wanted.end(), scales_staging.data());
      cuda.to_device(scales.data(), scales_staging.data(), wanted.size() * sizeof(float));
      known_scales = std::move(wanted);
    }
    return {scales.data(), scales.data() + levels, s.levels};
  }
};

/// Where everything lies: in the block that is sent, if anything must be, and in the one that the
/// device writes.
class Plan {
 public:
  Plan(const ProjectionCall& call, ResidentStore::Pins& pins) : call_(call) {
    for (const LandmarksToSearch& l : call.landmarks) {
      landmarks_.push_back({l.resident ? pins.find(*l.resident) : nullptr, 0});
      if (!landmarks_.back().resident)
        landmarks_.back().at = input_.add<std::byte>(packed_landmark_bytes(l.count));
    }
    for (const TargetToSearch& t : call.targets) add_target(t, pins);
    if (parts_.size() > FewTargets::kMost) targets_ = input_.add<DeviceTarget>(parts_.size());
    counts_ = output_.add<std::uint32_t>(parts_.size());
    matches_ = output_.add<KeypointMatch>(num_winners_);
    words_ = output_.add<std::uint32_t>(num_words_);
  }

  std::size_t input_bytes() const { return input_.bytes(); }
  std::size_t output_bytes() const { return output_.bytes(); }
  std::size_t num_winners() const { return num_winners_; }
  std::size_t num_words() const { return num_words_; }

  /// Fills the block that is sent; it will lie at `device`. The device writes to `output`, which is
  /// page-locked.
  std::vector<DeviceTarget> pack(std::byte* host, const std::byte* device, std::byte* output,
                                 const SearchMemory& memory) const {
    for (std::size_t l = 0; l < landmarks_.size(); ++l)
      if (!landmarks_[l].resident)
        pack_landmarks(call_.landmarks[l].arrays, call_.landmarks[l].count,
                       host + landmarks_[l].at);
    for (const auto& [features, at] : transient_) pack_features(*features, host + at);
    std::vector<DeviceTarget> targets;
    for (std::size_t t = 0; t < parts_.size(); ++t)
      targets.push_back(pack_target(t, host, device, output, memory));
    if (targets.size() > FewTargets::kMost)
      std::memcpy(host + targets_, targets.data(), targets.size() * sizeof(DeviceTarget));
    std::memset(output + counts_, 0, parts_.size() * sizeof(std::uint32_t));
    return targets;
  }
  const DeviceTarget* targets(const std::byte* device) const {
    return reinterpret_cast<const DeviceTarget*>(device + targets_);
  }

  void unpack(const std::byte* output, ProjectionFound& found) const {
    found = {};
    const auto* counts = reinterpret_cast<const std::uint32_t*>(output + counts_);
    const auto* matches = reinterpret_cast<const KeypointMatch*>(output + matches_);
    std::size_t total = 0;
    for (std::size_t t = 0; t < parts_.size(); ++t) total += counts[t];
    found.lists.matches.reserve(total);
    for (std::size_t t = 0; t < parts_.size(); ++t) {
      found.lists.append({matches + parts_[t].winner, counts[t]});
      found.first_word.push_back(parts_[t].word);
    }
    found.first_word.push_back(num_words_);
    const auto* words = reinterpret_cast<const std::uint32_t*>(output + words_);
    found.in_view.assign(words, words + num_words_);
  }

 private:
  struct Landmarks {
    const std::byte* resident;  ///< null: in the block
    std::size_t at;
  };
  struct Parts {
    const std::byte* resident;
    std::size_t features = 0, blocked = 0, skipped = 0;  ///< places in the input
    std::size_t winner = 0, word = 0;                    ///< index of the first
  };

  void add_target(const TargetToSearch& t, ResidentStore::Pins& pins) {
    Parts p{pins.find(*t.features)};
    if (!p.resident) {
      // Several targets often search the same image.
      const auto [it, added] = transient_.try_emplace(t.features, 0);
      if (added) it->second = input_.add<std::byte>(packed_bytes(t.features->size()));
      p.features = it->second;
    }
    const std::size_t count = call_.landmarks[t.landmarks].count;
    if (t.view.features.blocked) p.blocked = input_.add<std::uint8_t>(t.features->size());
    if (t.view.landmark_skipped) p.skipped = input_.add<std::uint8_t>(count);
    p.winner = num_winners_;
    p.word = num_words_;
    num_winners_ += t.features->size();
    if (call_.want_in_view) num_words_ += (count + 31) / 32;
    parts_.push_back(p);
  }

  DeviceTarget pack_target(std::size_t t, std::byte* host, const std::byte* device,
                           std::byte* output, const SearchMemory& memory) const {
    const TargetToSearch& from = call_.targets[t];
    const FeatureView& f = from.view.features;
    const Parts& p = parts_[t];
    const std::size_t count = call_.landmarks[from.landmarks].count;
    const Landmarks& l = landmarks_[from.landmarks];
    const auto bytes = [&](std::size_t at, const std::uint8_t* source, std::size_t n) {
      if (!source) return static_cast<const std::uint8_t*>(nullptr);
      std::memcpy(host + at, source, n);
      return reinterpret_cast<const std::uint8_t*>(device + at);
    };
    DeviceTarget to;
    std::memset(static_cast<void*>(&to), 0, sizeof(to));
    to.view = from.view;
    to.view.features = {};
    to.view.landmark_skipped = bytes(p.skipped, from.view.landmark_skipped, count);
    to.blocked = bytes(p.blocked, f.blocked, static_cast<std::size_t>(f.size));
    to.features = packed_view(p.resident ? p.resident : device + p.features, f.size,
                              f.cell_width_px, f.cell_height_px);
    to.landmarks = packed_landmarks(l.resident ? l.resident : device + l.at, count);
    to.num_landmarks = static_cast<int>(count);
    to.winner = memory.winner.data() + p.winner;
    to.finished = memory.finished.data() + t;
    if (call_.want_in_view) to.in_view = memory.in_view.data() + p.word;
    to.host_in_view = reinterpret_cast<std::uint32_t*>(output + words_) + p.word;
    to.host_matches = reinterpret_cast<KeypointMatch*>(output + matches_) + p.winner;
    to.host_num_matches = reinterpret_cast<std::uint32_t*>(output + counts_) + t;
    return to;
  }

  const ProjectionCall& call_;
  BlockLayout input_, output_;
  std::size_t targets_ = 0, counts_ = 0, matches_ = 0, words_ = 0;
  std::size_t num_winners_ = 0, num_words_ = 0;
  std::vector<Landmarks> landmarks_;
  std::vector<Parts> parts_;
  std::unordered_map<const FeatureSet*, std::size_t> transient_;
};

template <class Targets>
void launch(CudaSession::Impl& cuda, const ProjectionCall& call, const ProjectionRule& rule,
            const Targets& targets) {
  static_assert(sizeof(ProjectionRule) + sizeof(Targets) < 4000, "parameters of a launch");
  std::size_t most = 0, pairs = 0;
  for (const TargetToSearch& t : call.targets) {
    most = std::max(most, call.landmarks[t.landmarks].count);
    pairs += call.landmarks[t.landmarks].count;
  }
  if (most == 0) return;
  // Few pairs: small blocks, so that every multiprocessor has some.
  const auto all = static_cast<std::size_t>(cuda.multiprocessors);
  const int chunk = pairs < 256 * all ? 32 : pairs < 1024 * all ? 64 : kThreads;
  const auto chunks = static_cast<unsigned>((most + chunk - 1) / chunk);
  const auto blocks = static_cast<unsigned>(chunks * call.targets.size());
  search_kernel<<<blocks, kThreads, 0, cuda.stream>>>(rule, targets, chunk, chunks);
  cuda.launched("search_kernel");
}

void run(CudaSession& session, const ProjectionCall& call, ProjectionFound& found) {
  const CudaRange range("projection search");
  CudaSession::Impl& cuda = session.impl();
  cuda.use();
  const auto store = session.part<ResidentStore>();
  const auto memory = session.part<CudaCallMemory>();
  const auto searches = session.part<SearchMemory>();
  ResidentStore::Pins pins(*store);
  CudaWaitOnFailure wait(cuda);
  const Plan plan(call, pins);
  memory->staging.reserve(cuda, plan.input_bytes());
  memory->input.reserve(cuda, plan.input_bytes());
  memory->results.reserve(cuda, plan.output_bytes());
  searches->prepare(cuda, plan.num_winners(), call.targets.size(), plan.num_words());
  searches->clean = false;  // until the search came to its end
  ProjectionRule rule = call.rule;
  rule.scales = searches->put(cuda, call.rule.scales);
  const auto targets = plan.pack(memory->staging.data(), memory->input.data(),
                                 memory->results.data(), *searches);
  cuda.to_device(memory->input.data(), memory->staging.data(), plan.input_bytes());
  pins.order(cuda.stream);
  if (targets.size() <= FewTargets::kMost) {
    FewTargets few;
    std::memcpy(static_cast<void*>(few.target), targets.data(),
                targets.size() * sizeof(DeviceTarget));
    launch(cuda, call, rule, few);
  } else {
    launch(cuda, call, rule, ManyTargets{plan.targets(memory->input.data())});
  }
  cuda.synchronize();
  wait.disarm();
  searches->clean = true;
  plan.unpack(memory->results.data(), found);
  cuda.bytes_to_host += found.lists.matches.size() * sizeof(KeypointMatch) +
                        (targets.size() + plan.num_words()) * sizeof(std::uint32_t);
}

}  // namespace

bool search_on_device(CudaSession& session, const ProjectionCall& call, ProjectionFound& found) {
  const std::lock_guard lock(session.mutex());
  if (!session.usable()) return false;
  try {
    run(session, call, found);
    return true;
  } catch (const CudaError& e) {
    session.report_failure("projection search", e.what());
    return false;
  }
}

}  // namespace fastloop::matching
