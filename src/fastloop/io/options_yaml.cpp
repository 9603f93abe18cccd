#include "fastloop/io/options_yaml.hpp"

#include <algorithm>
#include <functional>
#include <map>

#include "fastloop/core/error.hpp"
#include "fastloop/io/yaml_node.hpp"

namespace fastloop::io {
namespace {

using Setter = std::function<void(const YamlNode&)>;
using Fields = std::map<std::string, Setter>;

Setter into(double& field) {
  return [&field](const YamlNode& n) { field = n.number(); };
}
Setter into(float& field) {
  return [&field](const YamlNode& n) { field = static_cast<float>(n.number()); };
}
Setter into(int& field) {
  return [&field](const YamlNode& n) { field = n.integer(); };
}
Setter into(bool& field) {
  return [&field](const YamlNode& n) {
    const int value = n.integer();
    if (value != 0 && value != 1) n.fail("must be 0 or 1", "0 or 1");
    field = value == 1;
  };
}
Setter into(std::size_t& field) {
  return [&field](const YamlNode& n) {
    const int value = n.integer();
    if (value < 0) n.fail("must not be negative", "a whole number >= 0");
    field = static_cast<std::size_t>(value);
  };
}

void read_group(const YamlNode& root, const std::string& group, const Fields& fields) {
  const auto node = root.find(group);
  if (!node) return;
  for (const std::string& key : node->keys()) {
    const auto it = fields.find(key);
    if (it != fields.end()) {
      it->second(*node->find(key));
      continue;
    }
    std::string known;
    for (const auto& [name, setter] : fields) known += (known.empty() ? "" : ", ") + name;
    node->find(key)->fail("unknown key", "one of " + known);
  }
}

void read_options(const YamlNode& root, system::SystemOptions& o) {
  root.allow_only({"system", "orb", "tracking", "mapping", "loops"});
  read_group(root, "system", {{"mapping_delay_frames", into(o.mapping_delay_frames)}});
  read_group(root, "orb",
             {{"num_features", into(o.orb.num_features)},
              {"levels", into(o.orb.levels)},
              {"scale_factor", into(o.orb.scale_factor)},
              {"fast_threshold", into(o.orb.fast_threshold)},
              {"fast_min_threshold", into(o.orb.fast_min_threshold)}});
  auto& t = o.tracking;
  read_group(root, "tracking",
             {{"imu_noise_factor", into(t.imu_noise_factor)},
              {"min_initial_depth_points", into(t.min_initial_depth_points)},
              {"min_inliers", into(t.min_inliers)},
              {"min_inliers_inertial", into(t.min_inliers_inertial)},
              {"last_frame_radius_px", into(t.last_frame_radius_px)},
              {"last_frame_radius_inertial_px", into(t.last_frame_radius_inertial_px)},
              {"max_local_keyframes", into(t.max_local_keyframes)},
              {"recently_lost_s", into(t.recently_lost_s)},
              {"recently_lost_inertial_s", into(t.recently_lost_inertial_s)},
              {"close_depth_baselines", into(t.close_depth_baselines)},
              {"keyframe_interval_s", into(t.keyframe_interval_s)},
              {"keyframe_interval_before_imu_s", into(t.keyframe_interval_before_imu_s)},
              {"min_keyframe_interval_s", into(t.min_keyframe_interval_s)},
              {"keyframe_match_ratio", into(t.keyframe_match_ratio)}});
  auto& m = o.mapping;
  read_group(root, "mapping",
             {{"close_depth_baselines", into(m.close_depth_baselines)},
              {"min_stereo_landmarks", into(m.min_stereo_landmarks)},
              {"triangulation_neighbours", into(m.triangulation_neighbours)},
              {"fusion_neighbours", into(m.fusion_neighbours)},
              {"window_keyframes", into(m.window_keyframes)},
              {"window_keyframes_inertial", into(m.window_keyframes_inertial)},
              {"fixed_keyframes", into(m.fixed_keyframes)},
              {"max_window_points", into(m.max_window_points)},
              {"adjustment_iterations", into(m.adjustment_iterations)},
              {"adjustment_iterations_after_gate", into(m.adjustment_iterations_after_gate)},
              {"threads", into(m.threads)},
              {"redundant_share", into(m.redundant_share)},
              {"redundant_share_inertial", into(m.redundant_share_inertial)},
              {"max_imu_gap_s", into(m.max_imu_gap_s)},
              {"imu_min_keyframes", into(m.imu_min_keyframes)},
              {"imu_min_seconds", into(m.imu_min_seconds)},
              {"imu_refine_first_s", into(m.imu_refine_first_s)},
              {"imu_refine_second_s", into(m.imu_refine_second_s)}});
  auto& l = o.loops.loop;
  read_group(root, "loops",
             {{"adjust_globally", into(o.loops.adjust_globally)},
              {"max_adjusted_keyframes", into(o.loops.max_adjusted_keyframes)},
              {"min_keyframes", into(l.min_keyframes)},
              {"candidates", into(l.candidates)},
              {"ranked_candidates", into(l.ranked_candidates)},
              {"min_matches", into(l.min_matches)},
              {"min_wide_matches", into(l.min_wide_matches)},
              {"min_narrow_matches", into(l.min_narrow_matches)},
              {"min_covisible_matches", into(l.min_covisible_matches)},
              {"confirmations", into(l.confirmations)},
              {"max_tilt_rad", into(l.max_tilt_rad)},
              {"max_yaw_rad", into(l.max_yaw_rad)},
              {"max_drift_ratio", into(l.max_drift_ratio)},
              {"max_drift_constant_m", into(l.max_drift_constant_m)},
              {"graph_threads", into(l.graph_threads)}});
  try {
    o.validate();
  } catch (const InvalidArgument& e) {
    root.fail(e.what());
  }
}

}  // namespace

void load_options(const std::filesystem::path& file, system::SystemOptions& options) {
  read_options(YamlNode::load(file.string()), options);
}

void parse_options(const std::string& text, const std::string& name,
                   system::SystemOptions& options) {
  read_options(YamlNode::parse(text, name), options);
}

}  // namespace fastloop::io
