#include "fastloop/loop/landmark_update.hpp"

#include <algorithm>

namespace fastloop::loop {

std::vector<MovedLandmark> move_landmarks_reference(const map::Snapshot& snapshot,
                                                    const std::vector<map::CorrectedState>& states) {
  std::vector<SE3> T_world_body(snapshot.keyframe_slots());
  std::vector<Vector3d> centre_world(snapshot.keyframe_slots());
  for (std::uint32_t i = 0; i < snapshot.keyframe_slots(); ++i)
    T_world_body[i] = snapshot.T_world_body(KeyframeId(i));
  for (const map::CorrectedState& s : states)
    T_world_body[s.keyframe.value()] = s.after.T_world_body;
  for (std::size_t i = 0; i < T_world_body.size(); ++i)
    centre_world[i] = T_world_body[i] * snapshot.rig().T_body_left.translation;

  std::vector<MovedLandmark> moved;
  moved.reserve(snapshot.num_landmarks());
  for (std::uint32_t i = 0; i < snapshot.landmark_slots(); ++i) {
    const LandmarkId id(i);
    if (!snapshot.contains(id)) continue;
    const map::Landmark& l = snapshot.landmark(id);
    MovedLandmark m;
    m.landmark = id;
    // From the place in the uncorrected world to the corrected one.
    const SE3& anchor_before = snapshot.keyframe(l.anchor).state.T_world_body;
    const Vector3d p_anchor = anchor_before.inverse() * snapshot.p_world(id);
    m.p_world = T_world_body[l.anchor.value()] * p_anchor;
    std::uint8_t octave = 0;
    for (const map::Observation& o : l.observations) {
      m.normal_world += (m.p_world - centre_world[o.keyframe.value()]).normalized();
      if (o.keyframe == l.anchor)
        octave = snapshot.keyframe(l.anchor).data->features->octave[o.keypoint];
    }
    m.normal_world.normalize();
    const double distance = (m.p_world - centre_world[l.anchor.value()]).norm();
    m.max_distance_m = distance * static_cast<double>(snapshot.scales().scale[octave]);
    m.min_distance_m = m.max_distance_m / static_cast<double>(snapshot.scales().scale.back());
    moved.push_back(m);
  }
  return moved;
}

}  // namespace fastloop::loop
