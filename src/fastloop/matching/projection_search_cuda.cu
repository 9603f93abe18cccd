#include "fastloop/matching/projection_search_cuda.hpp"

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <unordered_map>

#include "fastloop/compute/cuda_call.cuh"
#include "fastloop/matching/device_scan.cuh"

namespace fastloop::matching {
namespace {

constexpr int kThreads = 128;

/// A target as the kernel reads it; pointers on the device.
struct DeviceTarget {
  TargetView view;
  PackedView features;
  const std::uint8_t* blocked;
  LandmarkArrays landmarks;
  int num_landmarks;
  unsigned long long* winner;
  std::uint32_t* in_view;
};

/// A landmark that passed the gates.
struct Seen {
  int landmark;
  Sighting sighting;
};

/// A block looks at `chunk` landmarks (a multiple of 32, at most kThreads) in one target: first a
/// thread for each, then, for the few that are in view, several lanes each, which share the rows of
/// the window.
template <int kLanes>
__global__ void __launch_bounds__(kThreads)
    search_kernel(const __grid_constant__ ProjectionRule rule, const DeviceTarget* targets,
                  int chunk, int chunks) {
  __shared__ Seen seen[kThreads];
  __shared__ int num_seen;
  const DeviceTarget& target = targets[blockIdx.x / chunks];
  const int first = static_cast<int>(blockIdx.x) % chunks * chunk;
  if (first >= target.num_landmarks) return;
  if (threadIdx.x == 0) num_seen = 0;
  __syncthreads();
  if (threadIdx.x < chunk) {
    const int i = first + static_cast<int>(threadIdx.x);
    const unsigned lane = threadIdx.x % 32;
    Sighting sighting;
    const std::uint8_t* skipped = target.view.landmark_skipped;
    const bool passed = i < target.num_landmarks && !(skipped && skipped[i]) &&
                        sight(rule, target.view, target.landmarks, i, &sighting);
    const unsigned votes = __ballot_sync(~0u, passed);
    int place = 0;
    if (lane == 0) {
      if (target.in_view) target.in_view[i / 32] = votes;
      place = atomicAdd(&num_seen, __popc(votes));
    }
    place = __shfl_sync(~0u, place, 0) + __popc(votes & ((1u << lane) - 1));
    if (passed) seen[place] = {i, sighting};
  }
  __syncthreads();
  if (target.features.size == 0) return;
  const int lane = static_cast<int>(threadIdx.x) % kLanes;
  for (int s = static_cast<int>(threadIdx.x) / kLanes; s < num_seen; s += kThreads / kLanes) {
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
}

/// Where everything lies in the one block that is sent and in the one that comes back.
class Plan {
 public:
  Plan(const ProjectionCall& call, ResidentStore::Pins& pins) : call_(call) {
    const auto levels = static_cast<std::size_t>(call.rule.scales.levels);
    targets_ = input_.add<DeviceTarget>(call.targets.size());
    scale_ = input_.add<float>(levels);
    sigma2_ = input_.add<float>(levels);
    for (const LandmarksToSearch& l : call.landmarks) {
      landmarks_.push_back({l.resident ? pins.find(*l.resident) : nullptr, 0});
      if (!landmarks_.back().resident)
        landmarks_.back().at = input_.add<std::byte>(packed_landmark_bytes(l.count));
    }
    for (const TargetToSearch& t : call.targets) add_target(t, pins);
    for (const TargetToSearch& t : call.targets) {
      Parts& p = parts_[static_cast<std::size_t>(&t - call.targets.data())];
      p.winner = num_winners_;
      num_winners_ += t.features->size();
    }
    output_.add<std::uint64_t>(num_winners_);
    if (!call.want_in_view) return;
    in_view_ = output_.bytes();
    for (std::size_t t = 0; t < parts_.size(); ++t) {
      parts_[t].word = num_words_;
      num_words_ += (call.landmarks[call.targets[t].landmarks].count + 31) / 32;
    }
    output_.add<std::uint32_t>(num_words_);
  }

  std::size_t input_bytes() const { return input_.bytes(); }
  std::size_t output_bytes() const { return output_.bytes(); }

  /// Fills the block that is sent; it will lie at `device`.
  /// @return the rule with pointers on the device
  ProjectionRule pack(std::byte* host, std::byte* device, std::byte* output) const {
    for (std::size_t l = 0; l < landmarks_.size(); ++l)
      if (!landmarks_[l].resident)
        pack_landmarks(call_.landmarks[l].arrays, call_.landmarks[l].count,
                       host + landmarks_[l].at);
    for (const auto& [features, at] : transient_) pack_features(*features, host + at);
    for (std::size_t t = 0; t < parts_.size(); ++t) {
      const DeviceTarget target = pack_target(t, host, device, output);
      std::memcpy(host + targets_ + t * sizeof(DeviceTarget), &target, sizeof(target));
    }
    ProjectionRule rule = call_.rule;
    const auto levels = static_cast<std::size_t>(rule.scales.levels);
    std::memcpy(host + scale_, rule.scales.scale, levels * sizeof(float));
    std::memcpy(host + sigma2_, rule.scales.sigma2, levels * sizeof(float));
    rule.scales.scale = reinterpret_cast<const float*>(device + scale_);
    rule.scales.sigma2 = reinterpret_cast<const float*>(device + sigma2_);
    return rule;
  }
  const DeviceTarget* targets(const std::byte* device) const {
    return reinterpret_cast<const DeviceTarget*>(device + targets_);
  }

  void unpack(const std::byte* output, ProjectionFound& found) const {
    found.winner.resize(num_winners_);
    found.in_view.resize(num_words_);
    std::memcpy(found.winner.data(), output, num_winners_ * sizeof(std::uint64_t));
    std::memcpy(found.in_view.data(), output + in_view_, num_words_ * sizeof(std::uint32_t));
    found.first_winner.clear();
    found.first_word.clear();
    for (const Parts& p : parts_) {
      found.first_winner.push_back(p.winner);
      found.first_word.push_back(p.word);
    }
    found.first_winner.push_back(num_winners_);
    found.first_word.push_back(num_words_);
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
    if (t.view.features.blocked) p.blocked = input_.add<std::uint8_t>(t.features->size());
    if (t.view.landmark_skipped)
      p.skipped = input_.add<std::uint8_t>(call_.landmarks[t.landmarks].count);
    parts_.push_back(p);
  }

  DeviceTarget pack_target(std::size_t t, std::byte* host, std::byte* device,
                           std::byte* output) const {
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
    to.winner = reinterpret_cast<unsigned long long*>(output) + p.winner;
    if (call_.want_in_view)
      to.in_view = reinterpret_cast<std::uint32_t*>(output + in_view_) + p.word;
    return to;
  }

  const ProjectionCall& call_;
  BlockLayout input_, output_;
  std::size_t targets_ = 0, scale_ = 0, sigma2_ = 0, in_view_ = 0;
  std::size_t num_winners_ = 0, num_words_ = 0;
  std::vector<Landmarks> landmarks_;
  std::vector<Parts> parts_;
  std::unordered_map<const FeatureSet*, std::size_t> transient_;
};

void launch(CudaSession::Impl& cuda, const ProjectionCall& call, const ProjectionRule& rule,
            const DeviceTarget* targets) {
  std::size_t most = 0, pairs = 0;
  for (const TargetToSearch& t : call.targets) {
    most = std::max(most, call.landmarks[t.landmarks].count);
    pairs += call.landmarks[t.landmarks].count;
  }
  if (most == 0) return;
  // Few pairs: small blocks, so that every multiprocessor has some.
  const auto all = static_cast<std::size_t>(cuda.multiprocessors);
  int chunk = pairs < 256 * all ? 32 : pairs < 1024 * all ? 64 : kThreads;
  if (const char* c = std::getenv("TUNE_CHUNK")) chunk = std::atoi(c);
  const int chunks = static_cast<int>((most + chunk - 1) / chunk);
  const auto blocks = static_cast<unsigned>(chunks * call.targets.size());
  const char* l = std::getenv("TUNE_LANES");
  const int lanes = l ? std::atoi(l) : 8;
  if (lanes == 1) search_kernel<1><<<blocks, kThreads, 0, cuda.stream>>>(rule, targets, chunk, chunks);
  if (lanes == 2) search_kernel<2><<<blocks, kThreads, 0, cuda.stream>>>(rule, targets, chunk, chunks);
  if (lanes == 4) search_kernel<4><<<blocks, kThreads, 0, cuda.stream>>>(rule, targets, chunk, chunks);
  if (lanes == 8) search_kernel<8><<<blocks, kThreads, 0, cuda.stream>>>(rule, targets, chunk, chunks);
  if (lanes == 16) search_kernel<16><<<blocks, kThreads, 0, cuda.stream>>>(rule, targets, chunk, chunks);
  cuda.launched("search_kernel");
}

void run(CudaSession& session, const ProjectionCall& call, ProjectionFound& found) {
  const CudaRange range("projection search");
  CudaSession::Impl& cuda = session.impl();
  cuda.use();
  const auto store = session.part<ResidentStore>();
  const auto memory = session.part<CudaCallMemory>();
  ResidentStore::Pins pins(*store);
  CudaWaitOnFailure wait(cuda);
  const Plan plan(call, pins);
  memory->staging.reserve(cuda, plan.input_bytes());
  memory->input.reserve(cuda, plan.input_bytes());
  memory->results.reserve(cuda, plan.output_bytes());
  memory->output.reserve(cuda, plan.output_bytes());
  std::byte* const output = memory->output.data();
  const ProjectionRule rule = plan.pack(memory->staging.data(), memory->input.data(), output);
  cuda.to_device(memory->input.data(), memory->staging.data(), plan.input_bytes());
  cuda.check(cudaMemsetAsync(output, 0xff, plan.output_bytes(), cuda.stream),
             "cudaMemsetAsync");
  pins.order(cuda.stream);
  launch(cuda, call, rule, plan.targets(memory->input.data()));
  cuda.to_host(memory->results.data(), output, plan.output_bytes());
  cuda.synchronize();
  wait.disarm();
  plan.unpack(memory->results.data(), found);
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
