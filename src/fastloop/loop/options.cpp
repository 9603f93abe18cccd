#include "fastloop/loop/options.hpp"

#include <string>

#include "fastloop/core/error.hpp"

namespace fastloop::loop {

void LoopOptions::validate() const {
  const auto require = [](bool ok, const char* what) {
    if (!ok) throw InvalidArgument(std::string("LoopOptions::") + what);
  };
  require(candidates >= 1, "candidates must be at least 1");
  require(ranked_candidates >= 1, "ranked_candidates must be at least 1");
  require(min_shared_ratio >= 0 && min_shared_ratio < 1, "min_shared_ratio must be in [0, 1)");
  require(min_ransac_inliers >= 3, "min_ransac_inliers must be at least 3");
  require(wide_radius_px > 0 && narrow_radius_px > 0 && covisible_radius_px > 0 &&
              fusion_radius_px > 0,
          "radii must be positive");
  require(confirmations >= 1, "confirmations must be at least 1");
  require(max_misses >= 1, "max_misses must be at least 1");
  require(max_tilt_rad > 0 && max_yaw_rad > 0, "max_tilt_rad and max_yaw_rad must be positive");
  require(max_drift_ratio >= 0 && max_drift_constant_m >= 0, "max_drift_ratio must not be negative");
  require(min_connection >= 1 && graph_min_connection >= 1, "connections need at least 1 landmark");
  require(graph_threads >= 1, "graph_threads must be at least 1");
}

}  // namespace fastloop::loop
