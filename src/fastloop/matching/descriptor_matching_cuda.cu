#include "fastloop/matching/descriptor_matching_cuda.hpp"

#include <algorithm>
#include <cstring>
#include <numeric>

#include "fastloop/compute/cuda_call.cuh"
#include "fastloop/matching/device_scan.cuh"
#include "fastloop/matching/resident_store.hpp"

namespace fastloop::matching {
namespace {

constexpr int kWarps = 4;  // of a block

/// An image as the kernel reads it; pointers on the device, or page-locked where they say host. What
/// follows `groups` is that of a second image.
struct DeviceSide {
  PackedView features;
  const std::uint8_t* blocked;
  GroupView groups;
  /// Distance << 16 | keypoint of the best claim on each keypoint; all bits set before and after.
  std::uint32_t* winner;
  unsigned* finished;  ///< blocks that are through with the image; 0 before and after
  MatchedPair* host_pairs;
  std::uint32_t* host_num_pairs;
};

/// Up to 32 keypoints of one group of the first image: the work of a warp, for each second image.
struct Unit {
  std::uint32_t node, begin, end;  ///< begin, end: of the group's indices
};

/// Where `node` stands among the ascending nodes, or -1; all lanes of a warp ask together.
__device__ int find_node(const GroupView& groups, std::uint32_t node) {
  const int lane = static_cast<int>(threadIdx.x) % 32;
  int first = 0, count = groups.size;
  while (count > 32) {
    const int step = (count + 31) / 32;
    const bool below = lane * step < count && groups.node[first + lane * step] <= node;
    const int passed = __popc(__ballot_sync(~0u, below));
    if (passed == 0) return -1;
    const int skipped = (passed - 1) * step;
    first += skipped;
    count = min(step, count - skipped);
  }
  const bool here = lane < count && groups.node[first + lane] == node;
  const unsigned votes = __ballot_sync(~0u, here);
  return votes ? first + __ffs(static_cast<int>(votes)) - 1 : -1;
}

__device__ int distance_between(const uint4 a[2], const uint4 b[2]) {
  return __popc(a[0].x ^ b[0].x) + __popc(a[0].y ^ b[0].y) + __popc(a[0].z ^ b[0].z) +
         __popc(a[0].w ^ b[0].w) + __popc(a[1].x ^ b[1].x) + __popc(a[1].y ^ b[1].y) +
         __popc(a[1].z ^ b[1].z) + __popc(a[1].w ^ b[1].w);
}

__device__ void load(const PackedView& f, int keypoint, uint4 out[2]) {
  const auto* words = reinterpret_cast<const uint4*>(f.descriptors + f.position[keypoint]);
  out[0] = words[0];
  out[1] = words[1];
}

/// The work of a warp. Each lane has one keypoint of the first image; those of the second pass by in
/// shared memory, 32 at a time.
__device__ void match_unit(const DeviceSide& first, const DeviceSide& second, const Unit& unit,
                           int max_distance, float best_to_second, uint4 (*descriptors)[2],
                           std::uint32_t* keypoints) {
  const int group = find_node(second.groups, unit.node);
  if (group < 0) return;
  const int lane = static_cast<int>(threadIdx.x) % 32;
  const bool mine = unit.begin + lane < unit.end;
  const int own = mine ? first.groups.indices[unit.begin + lane] : 0;
  const bool takes_part = mine && !(first.blocked && first.blocked[own]);
  uint4 query[2] = {};
  if (takes_part) load(first.features, own, query);

  BestTwo found;
  const std::uint32_t end = second.groups.start[group + 1];
  for (std::uint32_t begin = second.groups.start[group]; begin < end; begin += 32) {
    __syncwarp();
    std::uint32_t other = kNoKey;
    if (begin + lane < end) {
      other = second.groups.indices[begin + lane];
      if (second.blocked && second.blocked[other]) other = kNoKey;
    }
    keypoints[lane] = other;
    if (other != kNoKey) load(second.features, static_cast<int>(other), descriptors[lane]);
    __syncwarp();
    const int count = min(32, static_cast<int>(end - begin));
    for (int j = 0; j < count; ++j)
      if (const std::uint32_t k = keypoints[j]; k != kNoKey)
        found.take(static_cast<MatchKey>(distance_between(query, descriptors[j])) << 16 | k);
  }
  if (!takes_part) return;
  const MatchKey key = nearest_of(found, max_distance, best_to_second);
  if (key != kNoKey)
    atomicMin(second.winner + key_index(key),
              static_cast<MatchKey>(key_distance(key)) << 16 | static_cast<MatchKey>(own));
}

/// Writes the pairs of an image to the host, and leaves its memory as it was before.
__device__ void report(const DeviceSide& second) {
  const auto write = [&](int place, int k, std::uint32_t winner) {
    second.host_pairs[place] = {static_cast<std::uint16_t>(key_index(winner)),
                                static_cast<std::uint16_t>(k)};
  };
  const int written = take_claims<32 * kWarps>(second.winner, second.features.size, write);
  if (threadIdx.x != 0) return;
  *second.host_num_pairs = static_cast<std::uint32_t>(written);
  *second.finished = 0;
}

/// Columns of blocks are units of the first image, rows are second images; the last block of a row
/// reports it.
__global__ void __launch_bounds__(32 * kWarps)
    match_kernel(const __grid_constant__ DeviceSide first, const DeviceSide* seconds,
                 const Unit* units, int num_units, int max_distance, float best_to_second) {
  __shared__ uint4 descriptors[kWarps][32][2];
  __shared__ std::uint32_t keypoints[kWarps][32];
  __shared__ bool last;
  const DeviceSide& second = seconds[blockIdx.y];
  const int warp = static_cast<int>(threadIdx.x) / 32;
  const int u = static_cast<int>(blockIdx.x) * kWarps + warp;
  if (u < num_units)
    match_unit(first, second, units[u], max_distance, best_to_second, descriptors[warp],
               keypoints[warp]);
  __threadfence();  // claims are there before the block counts as finished
  __syncthreads();
  if (threadIdx.x == 0) {
    last = atomicAdd(second.finished, 1u) + 1 == gridDim.x;
    __threadfence();
  }
  __syncthreads();
  if (last) report(second);
}

/// What matching keeps on the device from call to call, a part of the session.
struct MatchMemory {
  explicit MatchMemory(CudaSession&) {}
  DeviceBuffer<std::uint32_t> winner;
  DeviceBuffer<unsigned> finished;
  bool clean = false;  ///< as a call expects them

  void prepare(CudaSession::Impl& cuda, std::size_t winners, std::size_t images) {
    if (winners > winner.capacity() || images > finished.capacity()) clean = false;
    winner.reserve(cuda, winners);
    finished.reserve(cuda, images);
    if (clean) return;
    if (winner.capacity() > 0)
      cuda.check(cudaMemsetAsync(winner.data(), 0xff, winner.capacity() * sizeof(std::uint32_t),
                                 cuda.stream),
                 "cudaMemsetAsync");
    cuda.clear(finished.data(), finished.capacity() * sizeof(unsigned));
    clean = true;
  }
};

/// An image whose keypoints are all compared is one group.
FeatureGroups one_group(std::size_t n) {
  FeatureGroups g{{0}, {0, static_cast<std::uint32_t>(n)}, {}};
  g.indices.resize(n);
  std::iota(g.indices.begin(), g.indices.end(), std::uint16_t{0});
  return g;
}

std::vector<Unit> units_of(const FeatureGroups& groups) {
  std::vector<Unit> units;
  for (std::size_t g = 0; g < groups.node.size(); ++g)
    for (std::uint32_t i = groups.start[g]; i < groups.start[g + 1]; i += 32)
      units.push_back({groups.node[g], i, std::min(groups.start[g + 1], i + 32)});
  return units;
}

/// The sides of one launch, packed one after another.
class Pack {
 public:
  explicit Pack(ResidentStore::Pins& pins) : pins_(pins) {}

  /// First round: finds a place for everything. Sides must be asked for in the same order in both.
  void plan(const SideToMatch& side, const FeatureGroups& groups) {
    Places p{pins_.find(*side.features), pins_.obtain(groups)};
    const std::size_t n = side.features->size();
    if (!p.resident) p.features = layout_.add<std::byte>(packed_bytes(n));
    if (!p.resident_groups) p.groups = layout_.add<std::byte>(packed_bytes(groups));
    if (side.blocked) p.blocked = layout_.add<std::uint8_t>(n);
    places_.push_back(p);
  }
  BlockLayout& layout() { return layout_; }

  void set_memory(std::byte* host, std::byte* device) { host_ = host, device_ = device; }
  template <class T>
  const T* put(std::size_t at, const T* source, std::size_t count) {
    if (count > 0) std::memcpy(host_ + at, source, count * sizeof(T));
    return reinterpret_cast<const T*>(device_ + at);
  }
  DeviceSide pack(const SideToMatch& side, const FeatureGroups& groups) {
    const Places& p = places_[next_++];
    const FeatureSet& f = *side.features;
    if (!p.resident) pack_features(f, host_ + p.features);
    if (!p.resident_groups) pack_groups(groups, host_ + p.groups);
    DeviceSide to;
    std::memset(static_cast<void*>(&to), 0, sizeof(to));
    to.features = packed_view(p.resident ? p.resident : device_ + p.features,
                              static_cast<int>(f.size()), f.grid.cell_width_px,
                              f.grid.cell_height_px);
    to.blocked = side.blocked ? put(p.blocked, side.blocked, f.size()) : nullptr;
    to.groups =
        packed_groups(p.resident_groups ? p.resident_groups : device_ + p.groups, groups);
    return to;
  }

 private:
  struct Places {
    const std::byte *resident, *resident_groups;  ///< null: in the block
    std::size_t features = 0, groups = 0, blocked = 0;
  };
  ResidentStore::Pins& pins_;
  BlockLayout layout_;
  std::vector<Places> places_;
  std::size_t next_ = 0;
  std::byte *host_ = nullptr, *device_ = nullptr;
};

/// The second images that are compared by groups, or all those that are not.
struct Batch {
  std::vector<std::size_t> seconds;
  std::vector<const FeatureGroups*> groups;  ///< of the second images
  const FeatureGroups* first = nullptr;
  std::vector<Unit> units;
  std::size_t units_at = 0, sides_at = 0;
};

class Matching {
 public:
  Matching(const DescriptorCall& call, ResidentStore::Pins& pins) : call_(call), pack_(pins) {
    all_of_first_ = one_group(call.first.features->size());
    whole_.resize(call.seconds.size());
    batches_[0].first = call.first.groups;
    batches_[1].first = &all_of_first_;
    for (std::size_t s = 0; s < call.seconds.size(); ++s) {
      const SideToMatch& second = call.seconds[s];
      const bool grouped = call.first.groups && second.groups;
      if (!grouped) whole_[s] = one_group(second.features->size());
      Batch& batch = batches_[grouped ? 0 : 1];
      batch.seconds.push_back(s);
      batch.groups.push_back(grouped ? second.groups : &whole_[s]);
      first_winner_.push_back(num_winners_);
      num_winners_ += second.features->size();
    }
    for (Batch& batch : batches_) {
      if (batch.seconds.empty()) continue;
      batch.units = units_of(*batch.first);
      pack_.plan(call.first, *batch.first);
      for (std::size_t i = 0; i < batch.seconds.size(); ++i)
        pack_.plan(call.seconds[batch.seconds[i]], *batch.groups[i]);
      batch.units_at = pack_.layout().add<Unit>(batch.units.size());
      batch.sides_at = pack_.layout().add<DeviceSide>(batch.seconds.size());
    }
    counts_at_ = output_.add<std::uint32_t>(call.seconds.size());
    pairs_at_ = output_.add<MatchedPair>(num_winners_);
  }

  std::size_t input_bytes() { return pack_.layout().bytes(); }
  std::size_t output_bytes() const { return output_.bytes(); }
  std::size_t num_winners() const { return num_winners_; }

  /// Fills the block at `host`, which is to be copied to `input`. The device writes to `output`,
  /// which is page-locked.
  void pack(std::byte* host, std::byte* input, std::byte* output, const MatchMemory& memory) {
    pack_.set_memory(host, input);
    for (std::size_t b = 0; b < 2; ++b) {
      const Batch& batch = batches_[b];
      if (batch.seconds.empty()) continue;
      first_[b] = pack_.pack(call_.first, *batch.first);
      units_[b] = pack_.put(batch.units_at, batch.units.data(), batch.units.size());
      std::vector<DeviceSide> sides;
      for (std::size_t i = 0; i < batch.seconds.size(); ++i) {
        const std::size_t s = batch.seconds[i];
        DeviceSide side = pack_.pack(call_.seconds[s], *batch.groups[i]);
        side.winner = memory.winner.data() + first_winner_[s];
        side.finished = memory.finished.data() + s;
        side.host_pairs = reinterpret_cast<MatchedPair*>(output + pairs_at_) + first_winner_[s];
        side.host_num_pairs = reinterpret_cast<std::uint32_t*>(output + counts_at_) + s;
        sides.push_back(side);
      }
      sides_[b] = pack_.put(batch.sides_at, sides.data(), sides.size());
    }
    std::memset(output + counts_at_, 0, call_.seconds.size() * sizeof(std::uint32_t));
  }
  void unpack(const std::byte* output, std::vector<std::vector<MatchedPair>>& pairs) const {
    const auto* counts = reinterpret_cast<const std::uint32_t*>(output + counts_at_);
    const auto* all = reinterpret_cast<const MatchedPair*>(output + pairs_at_);
    pairs.resize(call_.seconds.size());
    for (std::size_t s = 0; s < pairs.size(); ++s)
      pairs[s].assign(all + first_winner_[s], all + first_winner_[s] + counts[s]);
  }
  void launch(CudaSession::Impl& cuda) const {
    for (std::size_t b = 0; b < 2; ++b) {
      const Batch& batch = batches_[b];
      if (batch.units.empty()) continue;
      constexpr std::size_t kMostRows = 65535;  // of a grid
      const auto columns = static_cast<unsigned>((batch.units.size() + kWarps - 1) / kWarps);
      for (std::size_t s = 0; s < batch.seconds.size(); s += kMostRows) {
        const auto rows = static_cast<unsigned>(std::min(kMostRows, batch.seconds.size() - s));
        match_kernel<<<dim3(columns, rows), 32 * kWarps, 0, cuda.stream>>>(
            first_[b], sides_[b] + s, units_[b], static_cast<int>(batch.units.size()),
            call_.max_distance, call_.best_to_second);
        cuda.launched("match_kernel");
      }
    }
  }

 private:
  const DescriptorCall& call_;
  Pack pack_;
  FeatureGroups all_of_first_;
  std::vector<FeatureGroups> whole_;
  Batch batches_[2];  ///< with groups, without
  std::vector<std::size_t> first_winner_;
  std::size_t num_winners_ = 0;
  BlockLayout output_;
  std::size_t counts_at_ = 0, pairs_at_ = 0;
  DeviceSide first_[2];
  const Unit* units_[2] = {};
  const DeviceSide* sides_[2] = {};
};

void run(CudaSession& session, const DescriptorCall& call,
         std::vector<std::vector<MatchedPair>>& pairs) {
  const CudaRange range("descriptor matching");
  CudaSession::Impl& cuda = session.impl();
  cuda.use();
  const auto store = session.part<ResidentStore>();
  const auto memory = session.part<CudaCallMemory>();
  const auto matches = session.part<MatchMemory>();
  ResidentStore::Pins pins(*store);
  CudaWaitOnFailure wait(cuda);
  Matching matching(call, pins);
  memory->staging.reserve(cuda, matching.input_bytes());
  memory->input.reserve(cuda, matching.input_bytes());
  memory->results.reserve(cuda, matching.output_bytes());
  matches->prepare(cuda, matching.num_winners(), call.seconds.size());
  matches->clean = false;  // until the call came to its end
  matching.pack(memory->staging.data(), memory->input.data(), memory->results.data(), *matches);
  cuda.to_device(memory->input.data(), memory->staging.data(), matching.input_bytes());
  pins.order(cuda.stream);
  matching.launch(cuda);
  cuda.synchronize();
  wait.disarm();
  matches->clean = true;
  matching.unpack(memory->results.data(), pairs);
  for (const auto& p : pairs) cuda.bytes_to_host += p.size() * sizeof(MatchedPair) + 4;
}

}  // namespace

bool match_on_device(CudaSession& session, const DescriptorCall& call,
                     std::vector<std::vector<MatchedPair>>& pairs) {
  const std::lock_guard lock(session.mutex());
  if (!session.usable()) return false;
  try {
    run(session, call, pairs);
    return true;
  } catch (const CudaError& e) {
    session.report_failure("descriptor matching", e.what());
    return false;
  }
}

}  // namespace fastloop::matching
