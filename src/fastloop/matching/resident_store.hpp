#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/compute/slab_space.hpp"
#include "fastloop/matching/packed_features.hpp"
#include "fastloop/matching/packed_groups.hpp"

namespace fastloop::matching {

/// What a store did and holds.
struct ResidentStatistics {
  std::size_t feature_sets = 0;    ///< resident now, and groups of keypoints
  std::size_t bytes_taken = 0;     ///< by feature sets and landmarks
  std::size_t bytes_reserved = 0;  ///< slabs on the device
  std::uint64_t uploads = 0, evictions = 0;
};

class ResidentLandmarks;

/// Copies on the device of what searches read again and again: features of keyframes, their groups
/// by vocabulary node, and the landmarks of a place for as long as a search for it goes on. Features are found by their ContentId;
/// they are evicted, least recently used first, when the budget is reached, and uploaded anew by who
/// needs them: nothing is lost, the host has them all. Memory comes in slabs that stay where they
/// are; there is no fixed number of anything. Safe to use from several threads.
class ResidentStore {
 public:
  struct Impl;

  explicit ResidentStore(CudaSession& session);
  ~ResidentStore();
  ResidentStore(const ResidentStore&) = delete;
  ResidentStore& operator=(const ResidentStore&) = delete;

  /// Starts the upload of features that are not resident and returns before it is done: packing into
  /// page-locked memory is all that happens in the calling thread. From now on the features must not
  /// change. A device that fails is reported to the session, not thrown.
  void prefetch(const std::shared_ptr<const FeatureSet>& features);
  /// Forgets features; those that no longer exist are found without it.
  void erase(const FeatureSet& features);
  bool contains(const FeatureSet& features) const;

  /// Uploads landmarks, which stay until the returned object is gone. Null: the device failed, or
  /// the budget is spent on what is in use.
  /// @param landmarks  arrays on the host; normal_world may be null
  std::shared_ptr<const ResidentLandmarks> upload(const LandmarkArrays& landmarks,
                                                  std::size_t count);

  /// Evicts what is beyond it. Initially a quarter of the device's memory.
  void set_budget(std::size_t bytes);
  /// Size of slabs to come; larger blocks get a slab of their own.
  void set_slab(std::size_t bytes);
  ResidentStatistics statistics() const;

  /// Blocks that a search reads: not evicted while this object lives.
  class Pins {
   public:
    explicit Pins(ResidentStore& store) : store_(store) {}
    ~Pins();
    Pins(const Pins&) = delete;
    Pins& operator=(const Pins&) = delete;
    /// Device address of the packed features; null when they are not resident.
    const std::byte* find(const FeatureSet& features);
    /// Device address of packed groups, which are uploaded if they are not there yet; null when they
    /// have no name or there is no room.
    const std::byte* obtain(const FeatureGroups& groups);
    /// Device address of packed landmarks; null when they belong to another store.
    const std::byte* find(const ResidentLandmarks& landmarks);
    /// What comes later on `stream` (a cudaStream_t) finds the uploads of everything pinned done.
    void order(void* stream);

   private:
    const std::byte* find(std::uint64_t id);

    ResidentStore& store_;
    std::vector<std::uint64_t> ids_;
    std::uint64_t ticket_ = 0;
  };

 private:
  friend class ResidentLandmarks;
  std::shared_ptr<Impl> impl_;
};

/// The store of a session, made at the first call; null when the device cannot have one, which is
/// reported to the session.
std::shared_ptr<ResidentStore> resident_store(CudaSession& session);

/// Landmarks on the device; see ResidentStore::upload.
class ResidentLandmarks {
 public:
  ResidentLandmarks(std::weak_ptr<ResidentStore::Impl> store, const SlabSpace::Block& block,
                    const std::byte* address, std::size_t size, std::uint64_t ticket)
      : store_(std::move(store)), block_(block), address_(address), size_(size), ticket_(ticket) {}
  ~ResidentLandmarks();
  ResidentLandmarks(const ResidentLandmarks&) = delete;
  ResidentLandmarks& operator=(const ResidentLandmarks&) = delete;

  std::size_t size() const { return size_; }
  bool belongs_to(const ResidentStore& store) const;

 private:
  friend class ResidentStore::Pins;
  std::weak_ptr<ResidentStore::Impl> store_;
  SlabSpace::Block block_;
  const std::byte* address_;
  std::size_t size_;
  std::uint64_t ticket_;  ///< of the upload
};

}  // namespace fastloop::matching
