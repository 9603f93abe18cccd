#pragma once

#include <atomic>
#include <functional>
#include <memory>

#include "fastloop/core/timing.hpp"
#include "fastloop/map/correction.hpp"
#include "fastloop/map/keyframe_request.hpp"
#include "fastloop/map/map.hpp"
#include "fastloop/mapping/culling.hpp"
#include "fastloop/mapping/inertial_alignment.hpp"
#include "fastloop/mapping/options.hpp"

namespace fastloop::mapping {

/// Owner of the map: turns requests into keyframes, creates, merges and culls landmarks, adjusts
/// the surroundings, initialises the IMU. Synchronous; one thread at a time.
class Mapper {
 public:
  struct Callbacks {
    std::function<void(std::shared_ptr<const map::Snapshot>)> publish;  ///< a new version is ready
    std::function<void(Nanoseconds stamp_ns, const ImuStep&)>
        imu_event;  ///< IMU initialised, refined, failed
  };
  /// @param times  may be null; stages "insert", "create", "fuse", "adjust", "cull", "imu"
  Mapper(const StereoRig& rig, const PyramidScales& scales, const MappingOptions& options,
         Callbacks callbacks, StageTimes* times);

  /// Begins with a map of an earlier run; to be called first.
  void set_map(map::Map map) { map_ = std::move(map); }
  /// @param more_waiting  further requests are queued: optional work is skipped
  void process(const map::KeyframeRequest& request, bool more_waiting);
  /// Applies what loop closing found, or refuses it. Publishes nothing: the next
  /// keyframe does, or the caller.
  map::CorrectionOutcome apply(const map::LoopCorrection& correction);
  /// Abandons a running adjustment (the state so far is kept); callable from any thread.
  void cancel() { cancel_ = true; }

  const map::Map& map() const { return map_; }

 private:
  KeyframeId insert(const map::KeyframeRequest& request);
  void publish();

  MappingOptions options_;
  Callbacks callbacks_;
  StageTimes* times_;
  map::Map map_;
  LandmarkProbation probation_;
  std::atomic<bool> cancel_{false};
  Nanoseconds last_imu_attempt_ns_ = 0;
};

}  // namespace fastloop::mapping
