#include <ceres/ceres.h>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <array>

#include "fastloop/core/error.hpp"
#include "fastloop/optimization/pose_graph_baselines.hpp"
#include "fastloop/optimization/pose_graph_check.hpp"
#include "fastloop/optimization/pose_graph_residual.hpp"

namespace fastloop::optimization {
namespace {

/// Quaternion (x, y, z, w), translation, scale.
using Pose8 = std::array<double, 8>;

Sim3 to_pose(const double* p) {
  Sim3 x;
  x.rotation = Eigen::Quaterniond(p[3], p[0], p[1], p[2]);
  x.translation = Vector3d(p[4], p[5], p[6]);
  x.scale = p[7];
  return x;
}

void from_pose(const Sim3& x, double* p) {
  Eigen::Map<Eigen::Vector4d>(p, 4) = x.rotation.coeffs();
  Eigen::Map<Vector3d>(p + 4, 3) = x.translation;
  p[7] = x.scale;
}

/// Root U of the information, U^T U = information.
Matrix7d square_root(const Matrix7d& information, int size) {
  Matrix7d root = Matrix7d::Zero();
  const auto m = information.topLeftCorner(size, size);
  const Eigen::LLT<Eigen::MatrixXd> llt(m);
  if (llt.info() == Eigen::Success) {
    root.topLeftCorner(size, size) = llt.matrixU();
  } else {
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(m);
    root.topLeftCorner(size, size) = eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal() *
                                     eigen.eigenvectors().transpose();
  }
  return root;
}

/// World-frame update. Cost functions already return derivatives for the update, in the first
/// columns.
class WorldManifold : public ceres::Manifold {
 public:
  WorldManifold(PoseGraphKind kind, int tangent) : kind_(kind), tangent_(tangent) {}
  int AmbientSize() const override { return 8; }
  int TangentSize() const override { return tangent_; }
  bool Plus(const double* x, const double* delta, double* out) const override {
    Vector7d d = Vector7d::Zero();
    for (int i = 0; i < tangent_; ++i) d[i] = delta[i];
    from_pose(move_vertex(kind_, to_pose(x), d), out);
    return true;
  }
  bool PlusJacobian(const double*, double* jacobian) const override {
    std::fill(jacobian, jacobian + 8 * tangent_, 0.0);
    for (int i = 0; i < tangent_; ++i) jacobian[i * tangent_ + i] = 1;
    return true;
  }
  bool Minus(const double*, const double*, double*) const override { return false; }
  bool MinusJacobian(const double*, double*) const override { return false; }

 private:
  PoseGraphKind kind_;
  int tangent_;
};

template <int R>
class EdgeCost : public ceres::SizedCostFunction<R, 8, 8> {
 public:
  EdgeCost(PoseGraphKind kind, const Sim3& z, const Matrix7d& root)
      : kind_(kind), z_(z), root_(root.topLeftCorner<R, R>()) {}
  bool Evaluate(double const* const* p, double* residual, double** jacobians) const override {
    const Sim3 from = to_pose(p[0]), to = to_pose(p[1]);
    Eigen::Map<Eigen::Matrix<double, R, 1>> r(residual);
    if (jacobians == nullptr) {
      r.noalias() = root_ * edge_residual(kind_, from, to, z_).template head<R>();
      return true;
    }
    const EdgeLinearization l = linearize_edge(kind_, from, to, z_);
    r.noalias() = root_ * l.residual.template head<R>();
    const Eigen::Matrix<double, R, 7> j = root_ * l.jacobian_to.template topRows<R>();
    for (int side = 0; side < 2; ++side) {
      if (jacobians[side] == nullptr) continue;
      Eigen::Map<Eigen::Matrix<double, R, 8, Eigen::RowMajor>> out(jacobians[side]);
      out.template leftCols<7>() = side == 0 ? Eigen::Matrix<double, R, 7>(-j) : j;
      out.col(7).setZero();
    }
    return true;
  }

 private:
  PoseGraphKind kind_;
  Sim3 z_;
  Eigen::Matrix<double, R, R> root_;
};

/// 4-DoF edges on parameters (yaw, translation): no manifold needed.
class YawCost : public ceres::SizedCostFunction<6, 4, 4> {
 public:
  YawCost(const PoseGraphEdge& edge, const Matrix7d& root, const Sim3& from, const Sim3& to)
      : edge_(edge), root_(root.topLeftCorner<6, 6>()), from_(from), to_(to) {}

  static Sim3 pose(const Sim3& start, const double* p) {
    return Sim3(so3::exp(Vector3d(0, 0, p[0])) * start.rotation, Vector3d(p[1], p[2], p[3]), 1);
  }

  bool Evaluate(double const* const* p, double* residual, double** jacobians) const override {
    const Sim3 from = pose(from_, p[0]), to = pose(to_, p[1]);
    const Vector7d e = edge_residual(PoseGraphKind::kYaw, from, to, edge_.T_from_to);
    Eigen::Map<Vector6d>(residual).noalias() = root_ * e.head<6>();
    if (jacobians == nullptr) return true;
    const Matrix3d r_from_world = from.rotation.conjugate().toRotationMatrix();
    Eigen::Matrix<double, 6, 4> j = Eigen::Matrix<double, 6, 4>::Zero();
    j.block<3, 1>(0, 0) =
        so3::right_jacobian_inverse(-e.head<3>()) * r_from_world * Vector3d::UnitZ();
    j.block<3, 3>(3, 1) = r_from_world;
    using Out = Eigen::Map<Eigen::Matrix<double, 6, 4, Eigen::RowMajor>>;
    if (jacobians[1] != nullptr) Out(jacobians[1]).noalias() = root_ * j;
    if (jacobians[0] != nullptr) {
      j.block<3, 1>(3, 0) =
          r_from_world * Vector3d::UnitZ().cross(Vector3d(to.translation - from.translation));
      Out(jacobians[0]).noalias() = -(root_ * j);
    }
    return true;
  }

 private:
  PoseGraphEdge edge_;
  Matrix6d root_;
  Sim3 from_, to_;
};

class KernelLoss : public ceres::LossFunction {
 public:
  KernelLoss(RobustKernel kernel, double width) : kernel_(kernel), width_(width) {}
  void Evaluate(double squared, double rho[3]) const override {
    const RobustValue v = evaluate_robust_kernel(kernel_, width_, squared);
    rho[0] = v.cost;
    rho[1] = v.weight;
    rho[2] = 0;  // reweighting without second order, as in the other solvers
  }

 private:
  RobustKernel kernel_;
  double width_;
};

class Recorder : public ceres::IterationCallback {
 public:
  Recorder(const PoseGraphOptions& options, PoseGraphResult& result)
      : options_(options), result_(result) {}
  ceres::CallbackReturnType operator()(const ceres::IterationSummary& s) override {
    if (s.iteration > 0) ++result_.factorizations;
    if (s.step_is_successful || s.iteration == 0) {
      result_.cost_history.push_back(s.cost);
      if (s.iteration > 0) ++result_.iterations;
    }
    return s.cost <= options_.target_cost ? ceres::SOLVER_TERMINATE_SUCCESSFULLY
                                          : ceres::SOLVER_CONTINUE;
  }

 private:
  const PoseGraphOptions& options_;
  PoseGraphResult& result_;
};

ceres::Solver::Options solver_options(const PoseGraphOptions& options) {
  ceres::Solver::Options o;
  o.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  o.max_num_iterations = options.max_iterations;
  o.num_threads = options.threads;
  o.function_tolerance = options.relative_tolerance;
  o.gradient_tolerance = 1e-14;
  o.parameter_tolerance = 1e-14;
  o.initial_trust_region_radius = options.initial_trust_region_radius;
  o.max_trust_region_radius = 1e32;
  o.logging_type = ceres::SILENT;
  return o;
}

}  // namespace

void solve_with_ceres(PoseGraphProblem& problem, const PoseGraphOptions& options,
                      PoseGraphResult& result) {
  HeldVertices held;
  find_held_vertices(problem, held);
  result.components = held.components;
  result.anchored = held.anchored;
  const bool yaw = problem.kind == PoseGraphKind::kYaw;
  const int size = residual_size(problem.kind),
            tangent = tangent_size(problem.kind, problem.fixed_scale);
  std::vector<Matrix7d> roots;
  for (const PoseGraphInformation& w : problem.information) roots.push_back(square_root(w, size));

  ceres::Problem::Options problem_options;
  problem_options.disable_all_safety_checks = true;
  problem_options.loss_function_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  problem_options.manifold_ownership = ceres::DO_NOT_TAKE_OWNERSHIP;
  ceres::Problem model(problem_options);
  WorldManifold manifold(problem.kind, tangent);
  KernelLoss loss(options.robust_kernel, options.robust_width);
  std::vector<Pose8> blocks(problem.poses.size());
  for (std::size_t i = 0; i < blocks.size(); ++i) {
    if (yaw) {
      const Vector3d& t = problem.poses[i].translation;
      blocks[i] = {0, t.x(), t.y(), t.z()};
      model.AddParameterBlock(blocks[i].data(), 4);
    } else {
      from_pose(problem.poses[i], blocks[i].data());
      model.AddParameterBlock(blocks[i].data(), 8, &manifold);
    }
    if (held.held[i]) model.SetParameterBlockConstant(blocks[i].data());
  }
  for (const PoseGraphEdge& e : problem.edges) {
    const Matrix7d& root = roots[e.information];
    ceres::CostFunction* cost;
    if (yaw) {
      cost = new YawCost(e, root, problem.poses[e.from], problem.poses[e.to]);
    } else if (size == 6) {
      cost = new EdgeCost<6>(problem.kind, e.T_from_to, root);
    } else {
      cost = new EdgeCost<7>(problem.kind, e.T_from_to, root);
    }
    const bool robust = options.robust_kernel != RobustKernel::kNone &&
                        (e.switchable || options.robust_on_all_edges);
    model.AddResidualBlock(cost, robust ? &loss : nullptr, blocks[e.from].data(),
                           blocks[e.to].data());
  }

  ceres::Solver::Options o = solver_options(options);
  Recorder recorder(options, result);
  o.callbacks.push_back(&recorder);
  ceres::Solver::Summary summary;
  ceres::Solve(o, &model, &summary);
  result.initial_cost = summary.initial_cost;
  result.final_cost = summary.final_cost;
  result.times.linearize_ms = 1e3 * summary.jacobian_evaluation_time_in_seconds;
  result.times.factor_ms = 1e3 * summary.linear_solver_time_in_seconds;
  result.times.update_ms = 1e3 * summary.residual_evaluation_time_in_seconds;
  if (summary.termination_type == ceres::NO_CONVERGENCE) {
    result.status = PoseGraphStatus::kMaxIterations;
    result.reason = "ended by max_iterations";
  } else if (!summary.IsSolutionUsable()) {
    result.status = PoseGraphStatus::kStalled;
    result.reason = summary.message;
    return;
  }
  for (std::size_t i = 0; i < blocks.size(); ++i) {
    if (held.held[i]) continue;
    problem.poses[i] =
        yaw ? YawCost::pose(problem.poses[i], blocks[i].data()) : to_pose(blocks[i].data());
  }
}

}  // namespace fastloop::optimization
