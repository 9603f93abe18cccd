#include "fastloop/matching/resident_store.hpp"

namespace fastloop::matching {

/// Never made in this build: there is no session to make one for.
struct ResidentStore::Impl {};

ResidentStore::ResidentStore(CudaSession&) {}
ResidentStore::~ResidentStore() = default;
void ResidentStore::prefetch(const std::shared_ptr<const FeatureSet>&) {}
void ResidentStore::erase(const FeatureSet&) {}
bool ResidentStore::contains(const FeatureSet&) const { return false; }
std::shared_ptr<const ResidentLandmarks> ResidentStore::upload(const LandmarkArrays&, std::size_t) {
  return nullptr;
}
void ResidentStore::set_budget(std::size_t) {}
void ResidentStore::set_slab(std::size_t) {}
ResidentStatistics ResidentStore::statistics() const { return {}; }

ResidentStore::Pins::~Pins() = default;
const std::byte* ResidentStore::Pins::find(const FeatureSet&) { return nullptr; }
const std::byte* ResidentStore::Pins::find(std::uint64_t) { return nullptr; }
const std::byte* ResidentStore::Pins::obtain(const FeatureGroups&) { return nullptr; }
const std::byte* ResidentStore::Pins::find(const ResidentLandmarks&) { return nullptr; }
void ResidentStore::Pins::order(void*) {}

std::shared_ptr<ResidentStore> resident_store(CudaSession&) { return nullptr; }

ResidentLandmarks::~ResidentLandmarks() = default;
bool ResidentLandmarks::belongs_to(const ResidentStore&) const { return false; }

}  // namespace fastloop::matching
