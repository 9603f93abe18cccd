#pragma once

#include "fastloop/optimization/pose_graph.hpp"

/// The other back ends of solve_pose_graph. The problem has been checked. Rejection of outliers is
/// the block solver's alone; robust kernels work everywhere.
namespace fastloop::optimization {

/// Ceres with analytic derivatives, SPARSE_NORMAL_CHOLESKY, and a near-Gauss-Newton trust region by
/// default.
void solve_with_ceres(PoseGraphProblem& problem, const PoseGraphOptions& options,
                      PoseGraphResult& result);

/// What ORB-SLAM3 does with g2o: central differences with step 1e-9, Levenberg-Marquardt with
/// Nielsen's damping (first damping 1e-16 for Sim3 and 1e-5 of the largest diagonal entry
/// otherwise), scalar sparse LDLT analysed anew in every call, the end after three iterations that
/// lower the cost by less than 0.1 %. max_iterations 20 gives the published setting.
void solve_with_reference(PoseGraphProblem& problem, const PoseGraphOptions& options,
                          PoseGraphResult& result);

}  // namespace fastloop::optimization
