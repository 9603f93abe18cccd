#pragma once

#include <functional>
#include <string>
#include <vector>

#include "fastloop/sim/sequence.hpp"
#include "fastloop/system/system.hpp"

namespace fastloop::tests {

/// The rig of the simulator with the same field of view on half the columns and rows: four times faster to
/// render and to track, and still enough texture for every stage.
Calibration small_rig(sim::CameraKind kind);

/// Frames of a simulated sequence, all rendered.
struct Recording {
  explicit Recording(sim::CameraKind kind, double seconds, std::uint64_t seed = 1);

  sim::SimulatedSequence sequence;
  std::vector<FrameInput> frames;
};

/// Paints a stretch of the recording black, as a hand over the lens does.
void cover_lens(Recording& recording, double begin_s, double end_s);

/// Small features budget to suit the small images; deterministic.
system::SystemOptions small_options(system::Mode mode = system::Mode::kAuto);

/// Feeds every frame and finishes. `after_frame` is called after each, if given.
void feed(system::System& system, const Recording& recording, const std::function<void(std::size_t)>& after_frame = {});

std::size_t count_tracked(const system::System& system);
std::size_t count_events(const system::System& system, const std::string& kind);
/// RMSE of the final trajectory against the truth after SE3 alignment, metres; only frames in [begin, end).
double ate_m(const system::System& system, const sim::SimulatedSequence& truth, std::size_t begin = 0,
             std::size_t end = static_cast<std::size_t>(-1));
/// Angle between the estimated and the true direction of gravity at a frame, degrees.
double gravity_error_deg(const system::System& system, const sim::SimulatedSequence& truth, std::size_t frame);

}  // namespace fastloop::tests
