#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <typeindex>
#include <utility>
#include <vector>

/// The CUDA device as the rest of the library sees it: no CUDA header, the same in builds without.
namespace fastloop {

struct CudaDeviceInfo {
  int index = 0;
  std::string name;
  int compute_major = 0, compute_minor = 0;
  int multiprocessors = 0;
  std::size_t memory_bytes = 0, free_bytes = 0;
};

/// What there is. `reason` says why there is no device: not compiled in, no driver, none found.
struct CudaInventory {
  bool compiled_in = false;
  std::string driver_version, runtime_version;  ///< "13.0"
  std::vector<CudaDeviceInfo> devices;
  std::string reason;
};

/// Asks the driver; never throws.
CudaInventory cuda_inventory();

/// What a session did since it was opened.
struct CudaCounters {
  std::uint64_t launches = 0;
  std::uint64_t synchronizations = 0;  ///< times the host waited
  std::uint64_t allocations = 0;       ///< of device or pinned memory
  std::uint64_t bytes_to_device = 0, bytes_to_host = 0;
  std::uint64_t reserved_bytes = 0;  ///< of device memory, by this session; it gives none back
};

/// One stream on one device with memory of its own. Steps that run on it take the mutex for their
/// duration, so that one session may be shared; different sessions run side by side.
class CudaSession {
 public:
  struct Impl;  ///< cuda_support.cuh

  /// Null where there is no device; `reason` then says why (may be null).
  static std::shared_ptr<CudaSession> open(std::string* reason = nullptr);
  /// The session of everyone who does not bring one, opened at the first call; null without a
  /// device, which is logged once.
  static std::shared_ptr<CudaSession> process_wide();
  /// What that session did; nothing if it was never asked for or there is no device.
  static std::optional<CudaCounters> process_wide_counters();
  ~CudaSession();
  CudaSession(const CudaSession&) = delete;
  CudaSession& operator=(const CudaSession&) = delete;

  /// False after an error that the device does not recover from: steps go to the CPU from then on.
  bool usable() const;
  /// To be called where a step failed: logs the first failure of each kind, and retires the session
  /// if the device no longer answers.
  void report_failure(const char* step, const std::string& what);
  CudaCounters counters() const;
  /// Tests: the n-th checked call from now on fails as out of memory (`lost` false) or as a lost
  /// device; n = 1 is the next one.
  void inject_failure(int n, bool lost);

  /// What a module keeps with the session, for example memory that it uses again: made by
  /// T(CudaSession&) at the first call, destroyed with the session and before its stream.
  template <class T>
  std::shared_ptr<T> part() {
    const std::lock_guard lock(parts_mutex_);
    for (const auto& [type, part] : parts_)
      if (type == typeid(T)) return std::static_pointer_cast<T>(part);
    auto made = std::make_shared<T>(*this);
    parts_.emplace_back(typeid(T), made);
    return made;
  }

  std::mutex& mutex() { return mutex_; }
  Impl& impl() { return *impl_; }

 private:
  CudaSession();
  std::unique_ptr<Impl> impl_;
  std::mutex mutex_, report_mutex_;
  std::set<std::string> reported_;  // failures already logged
  std::recursive_mutex parts_mutex_;
  std::vector<std::pair<std::type_index, std::shared_ptr<void>>> parts_;
};

}  // namespace fastloop
