#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string_view>
#include <vector>

#include "fastloop/optimization/pose_graph.hpp"

namespace fastloop::io {

/// How the information in EDGE_SE3:QUAT lines is read; programs differ.
enum class G2oInformation : int {
  kQuaternion,      ///< weights the vector part of the quaternion, half the rotation vector: as g2o does
  kRotationVector,  ///< weights the rotation vector, as GTSAM and the example of Ceres do
  kIsotropic,       ///< weights the rotation vector and translation by the harmonic mean of the eigenvalues: the
                    ///< problem that SE-Sync solves; half its chordal objective is then the cost
};

/// The reading under which results can be checked against certified optima; docs/pose-graph.md says more.
inline constexpr G2oInformation kDefaultG2oInformation = G2oInformation::kIsotropic;

/// A pose graph as a g2o file holds it.
struct G2oGraph {
  optimization::PoseGraphProblem problem;
  std::vector<std::int64_t> ids;  ///< [n] vertex ids of the file, ascending
  /// [edges] information of EDGE_SE3:QUAT lines as it was read, in the order of the file; empty unless it was read
  /// as kIsotropic, which keeps only its means. Written back as it was.
  std::vector<Matrix6d> se3_information;
};

/// Reads a g2o file:
///   VERTEX_SE3:QUAT, EDGE_SE3:QUAT    as g2o
///   VERTEX_SE2, EDGE_SE2              lifted into the plane z = 0
///   VERTEX_SIM3:QUAT, EDGE_SIM3:QUAT  as SE3:QUAT with the scale after the quaternion; information of edges 7 x 7 in
///                                     the order translation, rotation, log scale; ":QUAT" may be missing
///   VERTEX_SIM3:EXPMAP, EDGE_SIM3:EXPMAP  as g2o
///   FIX id ...
/// Other lines starting with a tag that is none of these are an error; empty lines and lines starting with # are
/// skipped.
///
/// `dof` is 4, 6 or 7; without it 7 for files with SIM3, 4 for files with SE2 only (there it is exactly the planar
/// problem: nothing moves out of the plane), 6 otherwise. Information is converted so that the quadratic form of
/// small residuals stays the same whatever the kind of problem.
/// @throws InputError with the line for anything that cannot be read, for edges to vertices that are not in the file,
///         and for numbers that are not finite
G2oGraph read_g2o(const std::filesystem::path& path, std::optional<int> dof = std::nullopt,
                  G2oInformation information = kDefaultG2oInformation);
G2oGraph parse_g2o(std::string_view text, const std::filesystem::path& name,
                   std::optional<int> dof = std::nullopt,
                   G2oInformation information = kDefaultG2oInformation);

/// Writes SE3:QUAT (kYaw, kSe3) or SIM3:QUAT (kSim3) lines with 17 significant digits.
void write_g2o(const std::filesystem::path& path, const G2oGraph& graph,
               G2oInformation information = kDefaultG2oInformation);

}  // namespace fastloop::io
