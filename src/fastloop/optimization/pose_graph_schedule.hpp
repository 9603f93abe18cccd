#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "fastloop/optimization/pose_graph_device_types.hpp"
#include "fastloop/optimization/pose_graph_dissection.hpp"

namespace fastloop::optimization::device {

/// The elimination of one graph as flat arrays, see View for their meaning.
struct Schedule {
  int block_size = 0, num_vertices = 0, num_slots = 0, num_poses = 0;
  std::vector<Front> fronts;
  std::vector<Task> tasks;
  std::vector<std::int32_t> ascent, descent, children, rows, map, edges_begin, edges, pose_of, from,
      to, edge_of_slot;
  std::vector<Pair> pairs;
  std::size_t panel_doubles = 0, schur_doubles = 0, rhs_blocks = 0, tile_flags = 0;
  /// What one task needs at most.
  std::size_t factor_shared_doubles = 0, solve_rows = 0, solve_panel_doubles = 0;
  // Counts for those who want to know how far from the limit a run is.
  int levels = 0, tiled_fronts = 0;
  double critical_columns = 0;  ///< unknowns eliminated one after the other
  double multiply_adds = 0;     ///< of one factorisation
};

struct ScheduleInput {
  int block_size = 0;
  int num_poses = 0;
  const std::vector<int>* ends = nullptr;        ///< [edges][2] poses
  const std::vector<int>* free_index = nullptr;  ///< [poses] vertex or -1
  const std::vector<int>* free_pose = nullptr;   ///< [vertices]
};

/// Fronts larger than `max_shared_doubles` are cut into tiles.
void build_schedule(const ScheduleInput& input, const block::Graph& graph,
                    const Dissection& dissection, std::size_t max_shared_doubles,
                    Schedule& schedule);

}  // namespace fastloop::optimization::device
