#include <algorithm>
#include <array>
#include <list>
#include <mutex>
#include <optional>
#include <unordered_map>

#include "fastloop/compute/cuda_support.cuh"
#include "fastloop/matching/resident_store.hpp"

namespace fastloop::matching {

namespace {

constexpr std::size_t kStagingBytes = 96 << 10;  // a set of 1,500 keypoints, before growing
constexpr int kStagingSlots = 16;

/// A resident set; the list of them is in order of use.
struct Entry {
  std::uint64_t id = 0;
  SlabSpace::Block block;
  std::uint64_t ticket = 0;  ///< of its upload
  int pins = 0;
  std::weak_ptr<const FeatureSet> features;
  bool has_owner = false;  ///< `features` tells when the set is gone
};

/// Page-locked memory on the way of one upload.
struct Staging {
  PinnedBuffer<std::byte> memory;
  cudaEvent_t done = nullptr;
  bool used = false;
};

}  // namespace

struct ResidentStore::Impl {
  explicit Impl(CudaSession& s) : session(s), cuda(s.impl()), next_checked(entries.end()) {}
  ~Impl();
  void open();

  std::byte* address(const SlabSpace::Block& b) const { return slabs[b.slab] + b.offset; }
  std::optional<SlabSpace::Block> allocate(std::size_t bytes);
  bool grow(std::size_t bytes);
  bool evict_one();
  void remove(std::list<Entry>::iterator entry);
  void forget_dead();
  template <class Pack>
  std::uint64_t upload(const SlabSpace::Block& block, std::size_t bytes, const Pack& pack);
  /// Finds room for a set, uploads and enters it; null when there is no room.
  template <class Pack>
  Entry* insert(std::uint64_t id, std::size_t bytes, const Pack& pack);
  /// Runs body() and turns a failure of the device into a report.
  template <class Body>
  bool guarded(const Body& body);

  CudaSession& session;
  CudaSession::Impl& cuda;
  mutable std::mutex mutex;
  std::size_t budget = 0, slab_bytes = std::size_t{32} << 20;
  SlabSpace space;
  std::vector<std::byte*> slabs;
  std::list<Entry> entries;  ///< most recently used first
  std::unordered_map<std::uint64_t, std::list<Entry>::iterator> by_id;
  std::list<Entry>::iterator next_checked;  ///< for forget_dead()
  cudaStream_t stream = nullptr;
  std::array<Staging, kStagingSlots> ring;
  std::size_t next_staging = 0;
  std::uint64_t last_ticket = 0, done_ticket = 0;  ///< uploads started, known to be done
  cudaEvent_t last_done = nullptr;                 ///< after the last upload
  ResidentStatistics counts;
};

void ResidentStore::Impl::open() {
  cuda.use();
  std::size_t free_bytes = 0, all_bytes = 0;
  cuda.check(cudaMemGetInfo(&free_bytes, &all_bytes), "cudaMemGetInfo");
  budget = all_bytes / 4;
  cuda.check(cudaStreamCreateWithFlags(&stream, cudaStreamNonBlocking), "cudaStreamCreate");
  for (Staging& staging : ring) {
    cuda.check(cudaEventCreateWithFlags(&staging.done, cudaEventDisableTiming), "cudaEventCreate");
    staging.memory.reserve(cuda, kStagingBytes);
  }
}

ResidentStore::Impl::~Impl() {
  if (stream) {
    cudaStreamSynchronize(stream);
    cudaStreamDestroy(stream);
  }
  for (Staging& staging : ring)
    if (staging.done) cudaEventDestroy(staging.done);
  for (std::byte* slab : slabs) cudaFree(slab);
}

/// Within the budget; evicts what it must. Nothing when all that is left is in use.
std::optional<SlabSpace::Block> ResidentStore::Impl::allocate(std::size_t bytes) {
  const std::size_t rounded = SlabSpace::rounded(bytes);
  for (;;) {
    if (space.bytes_taken() + rounded <= budget) {
      if (const auto block = space.take(bytes)) return block;
      if (grow(rounded)) continue;
    }
    if (!evict_one()) return std::nullopt;
  }
}

bool ResidentStore::Impl::grow(std::size_t bytes) {
  const std::size_t reserved = space.bytes_reserved();
  if (reserved + bytes > budget) return false;
  const std::size_t wanted = std::max(bytes, std::min(slab_bytes, budget - reserved));
  void* memory = nullptr;
  const cudaError_t error = cudaMalloc(&memory, wanted);
  if (error == cudaErrorMemoryAllocation) {
    cudaGetLastError();
    return false;
  }
  cuda.check(error, "cudaMalloc");
  ++cuda.allocations;
  cuda.slab_bytes += wanted;
  slabs.push_back(static_cast<std::byte*>(memory));
  space.add_slab(wanted);
  return true;
}

void ResidentStore::Impl::remove(std::list<Entry>::iterator entry) {
  if (next_checked == entry) ++next_checked;
  space.give_back(entry->block);
  by_id.erase(entry->id);
  entries.erase(entry);
}

bool ResidentStore::Impl::evict_one() {
  for (auto entry = entries.end(); entry != entries.begin();)
    if ((--entry)->pins == 0) {
      remove(entry);
      ++counts.evictions;
      return true;
    }
  return false;
}

/// A few sets at a time: drops those that no longer exist.
void ResidentStore::Impl::forget_dead() {
  for (int i = 0; i < 4 && !entries.empty(); ++i) {
    if (next_checked == entries.end()) next_checked = entries.begin();
    const auto entry = next_checked++;
    if (entry->pins == 0 && entry->has_owner && entry->features.expired()) remove(entry);
  }
}

/// Memory of a block that was used before is free by now: whoever reads pins it until the device is
/// through.
template <class Pack>
std::uint64_t ResidentStore::Impl::upload(const SlabSpace::Block& block, std::size_t bytes,
                                          const Pack& pack) {
  Staging& staging = ring[next_staging];
  next_staging = (next_staging + 1) % ring.size();
  if (staging.used && cudaEventQuery(staging.done) != cudaSuccess) {
    cudaGetLastError();
    ++cuda.synchronizations;
    cuda.check(cudaEventSynchronize(staging.done), "cudaEventSynchronize");
  }
  staging.memory.reserve(cuda, bytes);
  pack(staging.memory.data());
  cuda.check(cudaMemcpyAsync(address(block), staging.memory.data(), bytes, cudaMemcpyHostToDevice,
                             stream),
             "cudaMemcpyAsync");
  cuda.bytes_to_device += bytes;
  cuda.check(cudaEventRecord(staging.done, stream), "cudaEventRecord");
  staging.used = true;
  last_done = staging.done;
  ++counts.uploads;
  return ++last_ticket;
}

template <class Pack>
Entry* ResidentStore::Impl::insert(std::uint64_t id, std::size_t bytes, const Pack& pack) {
  const auto block = allocate(bytes);
  if (!block) return nullptr;
  Entry entry;
  entry.id = id;
  entry.block = *block;
  try {
    entry.ticket = upload(*block, bytes, pack);
  } catch (...) {
    space.give_back(*block);
    throw;
  }
  entries.push_front(std::move(entry));
  by_id.emplace(id, entries.begin());
  return &entries.front();
}

template <class Body>
bool ResidentStore::Impl::guarded(const Body& body) {
  if (!session.usable()) return false;
  try {
    cuda.use();
    return body();
  } catch (const CudaError& e) {
    session.report_failure("upload", e.what());
    return false;
  }
}

ResidentStore::ResidentStore(CudaSession& session) : impl_(std::make_shared<Impl>(session)) {
  impl_->open();
}
ResidentStore::~ResidentStore() = default;

void ResidentStore::prefetch(const std::shared_ptr<const FeatureSet>& features) {
  make_feature_view(*features, {});  // throws on broken input before anything is taken
  const std::uint64_t id = features->id.assign();
  const std::lock_guard lock(impl_->mutex);
  impl_->guarded([&] {
    Impl& s = *impl_;
    if (const auto known = s.by_id.find(id); known != s.by_id.end()) {
      s.entries.splice(s.entries.begin(), s.entries, known->second);
      return true;
    }
    s.forget_dead();
    Entry* entry = s.insert(id, packed_bytes(features->size()),
                            [&](std::byte* out) { pack_features(*features, out); });
    if (!entry) return false;
    entry->features = features;
    entry->has_owner = true;
    return true;
  });
}

void ResidentStore::erase(const FeatureSet& features) {
  const std::lock_guard lock(impl_->mutex);
  const auto known = impl_->by_id.find(features.id.value());
  if (known != impl_->by_id.end() && known->second->pins == 0) impl_->remove(known->second);
}

bool ResidentStore::contains(const FeatureSet& features) const {
  const std::lock_guard lock(impl_->mutex);
  return impl_->by_id.count(features.id.value()) > 0;
}

std::shared_ptr<const ResidentLandmarks> ResidentStore::upload(const LandmarkArrays& landmarks,
                                                               std::size_t count) {
  const std::lock_guard lock(impl_->mutex);
  std::shared_ptr<const ResidentLandmarks> made;
  impl_->guarded([&] {
    const std::size_t bytes = packed_landmark_bytes(count);
    const auto block = impl_->allocate(bytes);
    if (!block) return false;
    std::uint64_t ticket = 0;
    try {
      ticket = impl_->upload(*block, bytes,
                             [&](std::byte* out) { pack_landmarks(landmarks, count, out); });
    } catch (...) {
      impl_->space.give_back(*block);
      throw;
    }
    made = std::make_shared<const ResidentLandmarks>(impl_, *block, impl_->address(*block), count,
                                                     ticket);
    return true;
  });
  return made;
}

void ResidentStore::set_budget(std::size_t bytes) {
  const std::lock_guard lock(impl_->mutex);
  impl_->budget = bytes;
  while (impl_->space.bytes_taken() > bytes && impl_->evict_one()) {
  }
}

void ResidentStore::set_slab(std::size_t bytes) {
  const std::lock_guard lock(impl_->mutex);
  impl_->slab_bytes = bytes;
}

ResidentStatistics ResidentStore::statistics() const {
  const std::lock_guard lock(impl_->mutex);
  ResidentStatistics s = impl_->counts;
  s.feature_sets = impl_->entries.size();
  s.bytes_taken = impl_->space.bytes_taken();
  s.bytes_reserved = impl_->space.bytes_reserved();
  return s;
}

ResidentStore::Pins::~Pins() {
  const std::lock_guard lock(store_.impl_->mutex);
  for (const std::uint64_t id : ids_) --store_.impl_->by_id.at(id)->pins;
}

const std::byte* ResidentStore::Pins::find(std::uint64_t id) {
  Impl& s = *store_.impl_;
  const auto known = s.by_id.find(id);
  if (known == s.by_id.end()) return nullptr;
  Entry& entry = *known->second;
  s.entries.splice(s.entries.begin(), s.entries, known->second);
  ids_.push_back(id);
  ++entry.pins;
  ticket_ = std::max(ticket_, entry.ticket);
  return s.address(entry.block);
}

const std::byte* ResidentStore::Pins::find(const FeatureSet& features) {
  if (features.id.value() == 0) return nullptr;
  const std::lock_guard lock(store_.impl_->mutex);
  return find(features.id.value());
}

const std::byte* ResidentStore::Pins::obtain(const FeatureGroups& groups) {
  const std::uint64_t id = groups.id.value();
  if (id == 0) return nullptr;
  Impl& s = *store_.impl_;
  const std::lock_guard lock(s.mutex);
  if (const std::byte* there = find(id)) return there;
  const auto pack = [&](std::byte* out) { pack_groups(groups, out); };
  return s.insert(id, packed_bytes(groups), pack) ? find(id) : nullptr;
}

const std::byte* ResidentStore::Pins::find(const ResidentLandmarks& landmarks) {
  if (!landmarks.belongs_to(store_)) return nullptr;
  ticket_ = std::max(ticket_, landmarks.ticket_);
  return landmarks.address_;
}

void ResidentStore::Pins::order(void* stream) {
  Impl& s = *store_.impl_;
  const std::lock_guard lock(s.mutex);
  if (ticket_ <= s.done_ticket) return;
  const std::uint64_t last = s.last_ticket;
  if (cudaEventQuery(s.last_done) == cudaSuccess) {
    s.done_ticket = last;
    return;
  }
  cudaGetLastError();
  s.cuda.check(cudaStreamWaitEvent(static_cast<cudaStream_t>(stream), s.last_done, 0),
               "cudaStreamWaitEvent");
}

std::shared_ptr<ResidentStore> resident_store(CudaSession& session) {
  try {
    return session.part<ResidentStore>();
  } catch (const CudaError& e) {
    session.report_failure("resident store", e.what());
    return nullptr;
  }
}

bool ResidentLandmarks::belongs_to(const ResidentStore& store) const {
  return store_.lock() == store.impl_;
}

ResidentLandmarks::~ResidentLandmarks() {
  const auto store = store_.lock();
  if (!store) return;
  const std::lock_guard lock(store->mutex);
  store->space.give_back(block_);
}

}  // namespace fastloop::matching
