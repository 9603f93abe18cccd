#include "fastloop/io/g2o.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include <cmath>
#include <filesystem>
#include <limits>
#include <string>

#include "fastloop/core/error.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

using optimization::PoseGraphKind;

const char* kIdentity6 = " 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1";
const char* kIdentity7 = " 1 0 0 0 0 0 0 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1";

int line_of_error(const std::string& text) {
  try {
    parse_g2o(text, "graph.g2o");
  } catch (const InputError& e) {
    return e.where().line;
  }
  return -1;
}

TEST(G2o, ReadsSe3WithIdsInAnyOrder) {
  const std::string text = std::string("# two vertices\n") + "VERTEX_SE3:QUAT 9 4 5 6 0 0 0.6 0.8\r\n" +
                           "VERTEX_SE3:QUAT 2 1 2 3 0 0 0 2\n\nFIX 9\n" +
                           "EDGE_SE3:QUAT 9 2 1 0 0 0 0 0 1 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21\n";
  const G2oGraph g = parse_g2o(text, "graph.g2o", std::nullopt, G2oInformation::kQuaternion);
  EXPECT_EQ(g.problem.kind, PoseGraphKind::kSe3);
  ASSERT_EQ(g.ids, (std::vector<std::int64_t>{2, 9}));
  EXPECT_EQ(g.problem.poses[0].translation, Vector3d(1, 2, 3));
  EXPECT_DOUBLE_EQ(g.problem.poses[0].rotation.w(), 1);
  EXPECT_NEAR(g.problem.poses[1].rotation.z(), 0.6, 1e-15);
  EXPECT_EQ(g.problem.fixed, (std::vector<std::uint8_t>{0, 1}));
  ASSERT_EQ(g.problem.edges.size(), 1u);
  EXPECT_EQ(g.problem.edges[0].from, 1);
  EXPECT_EQ(g.problem.edges[0].to, 0);
  // The upper triangle is given row by row in the order translation, rotation; ours starts with rotation.
  const auto& w = g.problem.information[g.problem.edges[0].information];
  EXPECT_EQ(w(3, 3), 1);
  EXPECT_EQ(w(3, 0), 4);
  EXPECT_EQ(w(0, 0), 16);
  EXPECT_EQ(w(2, 2), 21);
  EXPECT_EQ(w(5, 2), 15);
  EXPECT_EQ(w, w.transpose());
  // Read as weights of the rotation vector, twice the residual, they count four times.
  const G2oGraph v = parse_g2o(text, "graph.g2o", std::nullopt, G2oInformation::kRotationVector);
  const auto& x = v.problem.information[v.problem.edges[0].information];
  EXPECT_EQ(x(0, 0), 64);
  EXPECT_EQ(x(3, 0), 8);
  EXPECT_EQ(x(3, 3), 1);
}

/// SE-Sync's weights: harmonic means of the eigenvalues, for the rotation vector, twice our residual.
TEST(G2o, DefaultReadingTakesIsotropicMeansAndWritesBackWhatItRead) {
  const std::string text =
      "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
      "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0.25 2 0 0 0 0 4 0 0 0 10 0 0 20 0 30\n";
  const G2oGraph g = parse_g2o(text, "graph.g2o");
  const auto& w = g.problem.information[0];
  EXPECT_NEAR(w(0, 0), 4 * 3 / (1 / 10.0 + 1 / 20.0 + 1 / 30.0), 1e-12);
  EXPECT_NEAR(w(3, 3), 3 / (1 / 1.0 + 1 / 2.0 + 1 / 4.0), 1e-12);
  EXPECT_TRUE(Matrix7d(w).isDiagonal());
  const auto path = std::filesystem::temp_directory_path() / ("fastloop_g2o_means_" + std::to_string(getpid()));
  write_g2o(path, g);
  const G2oGraph again = read_g2o(path, std::nullopt, G2oInformation::kQuaternion);
  const G2oGraph direct = parse_g2o(text, "graph.g2o", std::nullopt, G2oInformation::kQuaternion);
  EXPECT_EQ(again.problem.information[0], direct.problem.information[0]);
  std::filesystem::remove(path);
}

TEST(G2o, ReportsTheLine) {
  const std::string vertices = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\n";
  EXPECT_EQ(line_of_error(vertices + "EDGE_SE3:QUAT 0 7 1 0 0 0 0 0 1" + kIdentity6), 3);
  EXPECT_EQ(line_of_error(vertices + "EDGE_SE3:QUAT 0 1 nan 0 0 0 0 0 1" + kIdentity6), 3);
  EXPECT_EQ(line_of_error(vertices + "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 5"), 3);
  EXPECT_EQ(line_of_error(vertices + "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1" + kIdentity6 + " 1"), 3);
  EXPECT_EQ(line_of_error(vertices + "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 x" + kIdentity6), 3);
  EXPECT_EQ(line_of_error("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0\n"), 1);
  EXPECT_EQ(line_of_error("VERTEX_XY 0 0 0\n"), 1);
  EXPECT_EQ(line_of_error("\nVERTEX_SIM3:QUAT 0 0 0 0 0 0 0 1 -2\n"), 2);
  EXPECT_EQ(line_of_error("FIX 3\n"), 1);
  EXPECT_THROW(parse_g2o(vertices + vertices, "twice.g2o"), InputError);
  EXPECT_THROW(parse_g2o(vertices, "a.g2o", 5), InvalidArgument);
  EXPECT_THROW(read_g2o("does/not/exist.g2o"), InputError);
  EXPECT_EQ(line_of_error(""), -1);
}

/// Cost of a planar graph written down from g2o's definition of EDGE_SE2.
TEST(G2o, PlanarCostIsThatOfG2o) {
  const std::string text =
      "VERTEX_SE2 0 1 2 0.3\nVERTEX_SE2 1 2.5 2.2 0.9\n"
      "EDGE_SE2 0 1 1.4 -0.1 0.5 11 2 0 7 0 30\n";
  const G2oGraph g = parse_g2o(text, "planar.g2o");
  EXPECT_EQ(g.problem.kind, PoseGraphKind::kYaw);
  const double c = std::cos(0.3), s = std::sin(0.3), dx = 1.5, dy = 0.2;
  const double x = c * dx + s * dy - 1.4, y = -s * dx + c * dy + 0.1;
  const double zc = std::cos(0.5), zs = std::sin(0.5);
  const double ex = zc * x + zs * y, ey = -zs * x + zc * y, et = 0.9 - 0.3 - 0.5;
  const double expected = 0.5 * (11 * ex * ex + 2 * 2 * ex * ey + 7 * ey * ey + 30 * et * et);
  EXPECT_NEAR(optimization::pose_graph_cost(g.problem), expected, 1e-12);
}

TEST(G2o, PlanarGraphsStayInThePlane) {
  std::string text;
  for (int i = 0; i < 12; ++i)
    text += "VERTEX_SE2 " + std::to_string(i) + " " + std::to_string(0.9 * i) + " 0.1 " +
            std::to_string(0.02 * i) + "\n";
  for (int i = 0; i < 11; ++i)
    text += "EDGE_SE2 " + std::to_string(i) + " " + std::to_string(i + 1) + " 1 0 0.5 5 1 0 4 0 10\n";
  text += "EDGE_SE2 0 11 0.5 0.3 -0.8 5 1 0 4 0 10\n";
  for (int dof : {4, 6}) {
    G2oGraph g = parse_g2o(text, "planar.g2o", dof);
    const auto result = optimization::solve_pose_graph(g.problem);
    EXPECT_LT(result.final_cost, result.initial_cost);
    for (const Sim3& p : g.problem.poses) {
      EXPECT_NEAR(p.translation.z(), 0, 1e-12);
      EXPECT_NEAR(p.rotation.x(), 0, 1e-12);
    }
    if (dof != 4) continue;
    // A minimum of the planar problem: no small change of (x, y, theta) lowers the cost. The first is held.
    for (std::size_t i = 1; i < g.problem.poses.size(); ++i) {
      for (const Vector3d& d : {Vector3d(1, 0, 0), Vector3d(0, 1, 0), Vector3d(0, 0, 1)}) {
        for (double step : {-1e-3, 1e-3}) {
          optimization::PoseGraphProblem p = g.problem;
          p.poses[i].translation.head<2>() += step * d.head<2>();
          p.poses[i].rotation = so3::exp(Vector3d(0, 0, step * d.z())) * p.poses[i].rotation;
          EXPECT_GT(optimization::pose_graph_cost(p), result.final_cost) << i;
        }
      }
    }
  }
}

TEST(G2o, ReadsBothFormsOfSim3) {
  const Sim3 pose(so3::exp(Vector3d(0.1, -0.2, 0.3)), Vector3d(1, 2, 3), 1.5);
  const Vector7d d = pose.log();
  std::string text = "VERTEX_SIM3:EXPMAP 0";
  for (int i = 0; i < 7; ++i) text += " " + std::to_string(d[i]);
  text += " 500 500 320 240\nVERTEX_SIM3 1 1 2 3 0 0 0 1 1.25\n";
  text += "EDGE_SIM3:EXPMAP 0 1";
  for (int i = 0; i < 7; ++i) text += " " + std::to_string(d[i]);
  text += " 1 0 0 0 0 0 0 1 0 0 0 0 0 1 0 0 0 0 8 0 0 0 8 0 0 8 0 5\n";
  const G2oGraph g = parse_g2o(text, "sim3.g2o");
  EXPECT_EQ(g.problem.kind, PoseGraphKind::kSim3);
  EXPECT_NEAR((g.problem.poses[0].log() - d).norm(), 0, 1e-5);
  EXPECT_DOUBLE_EQ(g.problem.poses[1].scale, 1.25);
  EXPECT_NEAR((g.problem.edges[0].T_from_to.log() - d).norm(), 0, 1e-5);
  const auto& w = g.problem.information[0];  // EXPMAP is in our order already
  EXPECT_EQ(w(0, 0), 1);
  EXPECT_EQ(w(3, 3), 8);
  EXPECT_EQ(w(6, 6), 5);
}

TEST(G2o, RoundTripKeepsTheCost) {
  const std::string se3 = std::string("VERTEX_SE3:QUAT 3 0 0 0 0.1 0 0 1\nVERTEX_SE3:QUAT 5 1 0.1 0 0 0.1 0 1\n") +
                          "FIX 3\nEDGE_SE3:QUAT 3 5 0.9 0 0.1 0 0.05 0.02 1 9 1 0 0 0 0 8 0 0 0 0 7 0 0 0 6 0 0 5 0 4\n";
  const std::string sim3 = std::string("VERTEX_SIM3:QUAT 0 0 0 0 0.1 0 0 1 1\n") +
                           "VERTEX_SIM3:QUAT 1 1 0.1 0 0 0.1 0 1 1.2\nEDGE_SIM3:QUAT 0 1 1 0 0 0 0 0 1 1.1" +
                           kIdentity7 + "\n";
  const auto path = std::filesystem::temp_directory_path() / ("fastloop_g2o_test_" + std::to_string(getpid()));
  for (int dof : {4, 6, 7}) {
    for (auto meaning :
         {G2oInformation::kRotationVector, G2oInformation::kQuaternion, G2oInformation::kIsotropic}) {
      const G2oGraph first = parse_g2o(dof == 7 ? sim3 : se3, "a.g2o", dof, meaning);
      write_g2o(path, first, meaning);
      const G2oGraph second = read_g2o(path, dof, meaning);
      EXPECT_EQ(second.ids, first.ids);
      EXPECT_EQ(second.problem.fixed, first.problem.fixed);
      const double cost = optimization::pose_graph_cost(first.problem);
      EXPECT_GT(cost, 0);
      EXPECT_NEAR(optimization::pose_graph_cost(second.problem), cost, 1e-12 * cost);
    }
  }
  std::filesystem::remove(path);
}

}  // namespace
}  // namespace fastloop::io
