#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "fastloop/map/map.hpp"

namespace fastloop::map {

/// State of a keyframe before (as in the version the correction was computed from) and after.
struct CorrectedState {
  KeyframeId keyframe;
  NavState before, after;
};

/// New place of a landmark in the body frame of its anchor keyframe, which must still be `anchor`.
struct CorrectedPoint {
  LandmarkId landmark;
  KeyframeId anchor;
  Vector3d p_anchor = Vector3d::Zero();
};

/// What loop closing, map merging or a global adjustment wants changed. Plain data, computed from
/// one snapshot and applied to the map as one transaction.
struct LoopCorrection {
  enum class Kind {
    kLoop,        ///< closes a loop within `map`
    kMerge,       ///< welds `merged` to `map`
    kAdjustment,  ///< refines poses and landmarks; no loop edge
  };
  Kind kind = Kind::kLoop;
  std::uint64_t frame_version = 0;  ///< Snapshot::frame_version of the snapshot it came from
  MapId map;                        ///< that is corrected and stays
  MapId merged;                     ///< kMerge: that joins it
  LoopEdge edge;                    ///< a: matched keyframe, b: current one
  std::vector<CorrectedState> states;  ///< ascending keyframe id; keyframes not named stay, unless
                                       ///< newer than the newest one named
  std::vector<CorrectedPoint> points;
  std::vector<LandmarkMerge> merges;          ///< in this order
  std::vector<NewObservation> observations;   ///< after the merges, in this order
};

/// Bounds a correction has to keep.
struct CorrectionLimits {
  double max_edge_error_m = 0.5;      ///< corrected poses against the loop edge
  double max_edge_error_rad = 0.1;
  double observation_gate_px = 12;    ///< new observations and merges: reprojection error / scale of
                                      ///< the octave; at least half must be within
  double max_growth = 2;              ///< median reprojection error of observed landmarks, after / before
  double growth_floor_px = 1;         ///< below this median error growth does not count
};

/// Outcome of `apply_correction`.
struct CorrectionOutcome {
  bool applied = false;
  std::string reason;         ///< why it was refused
  SE3 T_new_old;              ///< how the newest keyframe's surroundings moved in the world
  std::size_t moved = 0;      ///< keyframes, those that arrived meanwhile included
  std::size_t merged = 0;     ///< landmarks that became one with another
  std::size_t observed = 0;   ///< new observations
  struct Times {
    double check_ms = 0;      ///< looking for a fault
    double poses_ms = 0;
    /// Joining landmarks, new observations; joining of maps. The reference does not tell covisibility
    /// apart and counts it here.
    double landmarks_ms = 0;
    double covisibility_ms = 0;
  } times;
};

/// Why a correction must not be applied to this map, in words: it was made for another version of
/// the world frame, names what does not exist, is not finite, contradicts its own loop edge, fits the
/// images worse than before, or moves a keyframe that no path joins to the loop. Reads only.
std::optional<std::string> find_fault(const Snapshot& map, const LoopCorrection& correction,
                                      const CorrectionLimits& limits = {},
                                      const Executor& executor = Executor::cpu());

/// Applies a correction completely or not at all. Keyframes that changed since the correction was
/// computed are moved by the same rigid motion as the state it names; keyframes that arrived since
/// follow the newest one it names before them. Landmarks follow their anchors. The result does not
/// depend on the executor; the reference joins landmarks one after another, as published.
CorrectionOutcome apply_correction(Map& map, const LoopCorrection& correction,
                                   const CorrectionLimits& limits = {},
                                   const Executor& executor = Executor::cpu());

}  // namespace fastloop::map
