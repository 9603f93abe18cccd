#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/core/timing.hpp"
#include "fastloop/features/frame_builder.hpp"
#include "fastloop/map/snapshot.hpp"
#include "fastloop/mapping/options.hpp"
#include "fastloop/sensor/calibration.hpp"
#include "fastloop/sensor/frame.hpp"
#include "fastloop/system/loop_closing.hpp"
#include "fastloop/tracking/types.hpp"

namespace fastloop::system {

enum class Mode { kAuto, kStereo, kStereoInertial, kRgbd };
const char* to_string(Mode mode);

struct SystemOptions {
  Mode mode = Mode::kAuto;     ///< kAuto: what the calibration offers
  bool deterministic = false;  ///< everything in the calling thread; the same poses as with threads
  /// Live operation: tracking sees the newest map at once, and no keyframe is requested while
  /// mapping is behind. Otherwise the frame count decides what tracking sees, and a run can be
  /// repeated bit by bit.
  bool drop_when_busy = false;
  /// Not live: tracking sees what mapping made of a keyframe this many frames later, and waits for
  /// it if need be. Less is fresher, more leaves mapping more time beside tracking.
  std::size_t mapping_delay_frames = 6;
  OrbOptions orb;
  tracking::TrackingOptions tracking;
  mapping::MappingOptions mapping;
  LoopClosingOptions loops;
  /// A map of an earlier run with the same cameras. New keyframes go to a map of their own, which
  /// joins it when the place is recognised.
  std::shared_ptr<const map::Snapshot> initial_map;
  bool localize_only = false;  ///< tracks in initial_map and changes nothing; without IMU
  void validate() const;  ///< throws InvalidArgument naming the field
};

/// Something a user may want to know later: state changes, IMU initialisation, new maps.
struct Event {
  Nanoseconds stamp_ns = 0;
  std::string kind;  ///< "initialised", "lost", "relocalised", "imu_initialised", ...
  std::string reason;
  MapId map;
  /// Of a correction: new world coordinates = T * old ones, for what is around the newest keyframe.
  /// A robot that keeps an odometry frame multiplies its T_map_odometry with it from the left.
  std::optional<SE3> T_new_old;
};

/// One processed frame.
struct FrameRecord {
  Nanoseconds stamp_ns = 0;
  tracking::State state = tracking::State::kInitialising;
  bool has_pose = false;
  SE3 live_T_world_body;  ///< as known at the time
  KeyframeId reference;   ///< the final pose is that of the keyframe times T_reference_body
  SE3 T_reference_body;
  int inliers = 0;
  double tracking_ms = 0;  ///< from images to pose, without waiting for mapping
};

/// The SLAM system: feed frames in time order, read poses and the map.
///
/// Threads: `process` is called from one thread and returns the pose of that frame; mapping runs in
/// a worker of its own (unless deterministic). What tracking sees of it follows the frame count, so
/// the result does not depend on the threads, except in live operation. `snapshot`, `events` may be
/// read from any thread. Errors of the worker are rethrown by the next `process` or by `finish`.
class System {
 public:
  System(const Calibration& calibration, const SystemOptions& options);
  ~System();

  /// IMU samples that are not finite or not in time order are ignored.
  /// @throws InvalidArgument on unordered stamps, images of the wrong size, or after `finish`; the
  /// frame is
  ///         left out and the next one may follow
  const FrameRecord& process(const FrameInput& input);
  /// Waits until mapping has done all that was asked; the map does not change any more. Idempotent.
  void finish();

  Mode mode() const;
  bool deterministic() const;
  std::shared_ptr<const map::Snapshot> snapshot() const;
  const std::vector<FrameRecord>& frames() const;
  /// In time order; what mapping reports of a keyframe comes after what tracking reported.
  std::vector<Event> events() const;
  /// Keyframes at which there was a loop to decide on, with the reasons; in order.
  std::vector<LoopRecord> loops() const;
  const StageTimes& times() const;
  bool imu_initialized() const;

  /// Final pose of a frame through its reference keyframe, if it was tracked.
  std::optional<SE3> T_world_body(const FrameRecord& frame) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace fastloop::system
