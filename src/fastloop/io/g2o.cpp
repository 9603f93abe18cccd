#include "fastloop/io/g2o.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <unordered_map>

#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

using optimization::PoseGraphEdge;
using optimization::PoseGraphInformation;
using optimization::PoseGraphKind;
using optimization::PoseGraphProblem;

enum class Family { kSe2, kSe3, kSim3, kSim3Expmap };

/// One line, split at blanks; complains with its place.
class Line {
 public:
  Line(std::string_view text, const std::filesystem::path& file, int number)
      : rest_(text), file_(file), number_(number) {}

  std::string_view word() {
    while (!rest_.empty() && (rest_.front() == ' ' || rest_.front() == '\t')) rest_.remove_prefix(1);
    const std::size_t length = std::min(rest_.find_first_of(" \t"), rest_.size());
    const std::string_view word = rest_.substr(0, length);
    rest_.remove_prefix(length);
    return word;
  }
  bool at_end() {
    Line copy = *this;
    return copy.word().empty();
  }
  double number(const char* what) {
    const std::string_view w = word();
    double value = 0;
    const auto [end, error] = std::from_chars(w.data(), w.data() + w.size(), value);
    if (w.empty() || error != std::errc() || end != w.data() + w.size()) fail(what, "is not a number", w);
    if (!std::isfinite(value)) fail(what, "is not finite", w);
    return value;
  }
  std::int64_t id(const char* what) {
    const std::string_view w = word();
    std::int64_t value = 0;
    const auto [end, error] = std::from_chars(w.data(), w.data() + w.size(), value);
    if (w.empty() || error != std::errc() || end != w.data() + w.size())
      fail(what, "is not a vertex id", w);
    return value;
  }
  [[noreturn]] void fail(const char* what, const std::string& message, std::string_view found = {}) const {
    throw InputError(in_file(file_, number_, what),
                     found.data() == nullptr ? message : message + ": '" + std::string(found) + "'");
  }

 private:
  std::string_view rest_;
  const std::filesystem::path& file_;
  int number_;
};

struct RawEdge {
  std::int64_t from, to;
  Sim3 measurement;
  Matrix7d information;  ///< g2o order: translation, rotation, log scale
  Family family;
  int line;
};

struct RawGraph {
  std::vector<std::pair<std::int64_t, Sim3>> vertices;
  std::vector<RawEdge> edges;
  std::vector<std::pair<std::int64_t, int>> fixed;  ///< id, line
  bool has_sim3 = false, has_se3 = false, has_se2 = false;
};

Sim3 read_pose(Line& line, Family family) {
  if (family == Family::kSe2) {
    const double x = line.number("x"), y = line.number("y"), theta = line.number("theta");
    return Sim3(so3::exp(Vector3d(0, 0, theta)), Vector3d(x, y, 0), 1);
  }
  if (family == Family::kSim3Expmap) {
    Vector7d d;
    for (int i = 0; i < 7; ++i) d[i] = line.number("tangent");
    return Sim3::exp(d);
  }
  double v[8] = {0, 0, 0, 0, 0, 0, 0, 1};
  for (int i = 0; i < (family == Family::kSim3 ? 8 : 7); ++i) v[i] = line.number("pose");
  const Eigen::Quaterniond q(v[6], v[3], v[4], v[5]);
  if (!(q.norm() > 1e-6)) line.fail("pose", "quaternion of length zero");
  if (!(v[7] > 0)) line.fail("pose", "scale must be positive");
  return Sim3(q, Vector3d(v[0], v[1], v[2]), v[7]);
}

/// Upper triangle, row by row.
Matrix7d read_information(Line& line, int size) {
  Matrix7d m = Matrix7d::Zero();
  for (int r = 0; r < size; ++r)
    for (int c = r; c < size; ++c) m(r, c) = m(c, r) = line.number("information");
  return m;
}

/// Planar information as that of a motion in space: the missing directions weigh as much as the others.
Matrix7d lift_information(const Matrix7d& planar) {
  Matrix7d m = Matrix7d::Zero();
  m.topLeftCorner<2, 2>() = planar.topLeftCorner<2, 2>();
  m(2, 2) = std::max(planar(0, 0), planar(1, 1));
  m(3, 3) = m(4, 4) = m(5, 5) = planar(2, 2);
  for (int i = 0; i < 2; ++i) m(i, 5) = m(5, i) = planar(i, 2);
  return m;
}

RawEdge read_edge(Line& line, Family family, int number) {
  RawEdge e;
  e.from = line.id("from");
  e.to = line.id("to");
  e.measurement = read_pose(line, family);
  e.family = family;
  e.line = number;
  if (family == Family::kSe2) {
    e.information = lift_information(read_information(line, 3));
  } else if (family == Family::kSe3) {
    e.information = read_information(line, 6);
  } else if (family == Family::kSim3) {
    e.information = read_information(line, 7);
  } else {
    // g2o orders the tangent of Sim3 as rotation, translation, log scale; bring it to the order of the others.
    const Matrix7d m = read_information(line, 7);
    const int order[7] = {3, 4, 5, 0, 1, 2, 6};
    for (int r = 0; r < 7; ++r)
      for (int c = 0; c < 7; ++c) e.information(r, c) = m(order[r], order[c]);
  }
  return e;
}

std::optional<Family> family_of(std::string_view tag) {
  if (tag == "SE2") return Family::kSe2;
  if (tag == "SE3:QUAT") return Family::kSe3;
  if (tag == "SIM3:QUAT" || tag == "SIM3") return Family::kSim3;
  if (tag == "SIM3:EXPMAP") return Family::kSim3Expmap;
  return std::nullopt;
}

void read_line(Line line, int number, RawGraph& graph) {
  const std::string_view tag = line.word();
  if (tag.empty() || tag.front() == '#') return;
  if (tag == "FIX") {
    while (!line.at_end()) graph.fixed.emplace_back(line.id("FIX"), number);
    return;
  }
  const bool vertex = tag.starts_with("VERTEX_"), edge = tag.starts_with("EDGE_");
  const std::optional<Family> family =
      vertex ? family_of(tag.substr(7)) : edge ? family_of(tag.substr(5)) : std::nullopt;
  if (!family) line.fail("tag", "unknown kind of line", tag);
  (*family == Family::kSe2 ? graph.has_se2 : *family == Family::kSe3 ? graph.has_se3 : graph.has_sim3) = true;
  if (vertex) {
    const std::int64_t id = line.id("id");
    graph.vertices.emplace_back(id, read_pose(line, *family));
    if (*family == Family::kSim3Expmap) return;  // the camera follows; it is no part of the graph
  } else {
    graph.edges.push_back(read_edge(line, *family, number));
  }
  if (!line.at_end()) line.fail("line", "more numbers than expected");
}

double harmonic_mean(const Matrix3d& m) {
  const double trace = m.inverse().trace();
  return trace > 0 && std::isfinite(trace) ? 3 / trace : 0;
}

/// From the file's order and residual to ours: rotation first, and half the rotation vector for kSe3, whose residual
/// is the vector part of the quaternion.
PoseGraphInformation convert_information(const RawEdge& e, PoseGraphKind kind, G2oInformation meaning) {
  const int order[7] = {3, 4, 5, 0, 1, 2, 6};
  PoseGraphInformation m;
  for (int r = 0; r < 7; ++r)
    for (int c = 0; c < 7; ++c) m(r, c) = e.information(order[r], order[c]);
  if (meaning == G2oInformation::kIsotropic && e.family == Family::kSe3) {
    const double rotation = harmonic_mean(m.topLeftCorner<3, 3>());
    const double translation = harmonic_mean(m.block<3, 3>(3, 3));
    m.setZero();
    m.diagonal().head<3>().setConstant(rotation);
    m.diagonal().segment<3>(3).setConstant(translation);
  }
  const bool file_has_vector = e.family != Family::kSe3 || meaning != G2oInformation::kQuaternion;
  const bool want_vector = kind != PoseGraphKind::kSe3;
  const double factor = file_has_vector == want_vector ? 1.0 : want_vector ? 0.5 : 2.0;
  m.topRows<3>() *= factor;
  m.leftCols<3>() *= factor;
  if (kind == PoseGraphKind::kSim3 && (e.family == Family::kSe2 || e.family == Family::kSe3)) m(6, 6) = m.diagonal().head<3>().mean();
  if (kind == PoseGraphKind::kYaw) {
    // The 4-DoF residual is not turned by the measured rotation, the others are.
    Matrix7d turn = Matrix7d::Identity();
    turn.block<3, 3>(3, 3) = e.measurement.rotation.toRotationMatrix();
    turn.block<3, 3>(0, 0) = turn.block<3, 3>(3, 3);
    m = turn * m * turn.transpose();
    m = (0.5 * (m + m.transpose())).eval();
  }
  if (kind != PoseGraphKind::kSim3) {
    m.row(6).setZero();
    m.col(6).setZero();
    m(6, 6) = 1;
  }
  return m;
}

PoseGraphKind choose_kind(const RawGraph& raw, std::optional<int> dof) {
  if (dof && *dof != 4 && *dof != 6 && *dof != 7) throw InvalidArgument("dof must be 4, 6 or 7");
  const int chosen = dof.value_or(raw.has_sim3 ? 7 : raw.has_se2 && !raw.has_se3 ? 4 : 6);
  return chosen == 4 ? PoseGraphKind::kYaw : chosen == 6 ? PoseGraphKind::kSe3 : PoseGraphKind::kSim3;
}

}  // namespace

G2oGraph parse_g2o(std::string_view text, const std::filesystem::path& name, std::optional<int> dof,
                   G2oInformation meaning) {
  RawGraph raw;
  int number = 0;
  while (!text.empty()) {
    const std::size_t length = std::min(text.find('\n'), text.size());
    std::string_view line = text.substr(0, length);
    text.remove_prefix(std::min(length + 1, text.size()));
    if (!line.empty() && line.back() == '\r') line.remove_suffix(1);
    ++number;
    read_line(Line(line, name, number), number, raw);
  }
  std::stable_sort(raw.vertices.begin(), raw.vertices.end(),
                   [](const auto& a, const auto& b) { return a.first < b.first; });

  G2oGraph graph;
  PoseGraphProblem& problem = graph.problem;
  problem.kind = choose_kind(raw, dof);
  std::unordered_map<std::int64_t, int> index;
  for (const auto& [id, pose] : raw.vertices) {
    if (!index.emplace(id, static_cast<int>(graph.ids.size())).second)
      throw InputError(in_file(name, 0, "vertex"), "vertex " + std::to_string(id) + " is defined twice");
    graph.ids.push_back(id);
    problem.poses.push_back(problem.kind == PoseGraphKind::kSim3 ? pose : Sim3(pose.rigid()));
  }
  const auto index_of = [&](std::int64_t id, int line) {
    const auto it = index.find(id);
    if (it == index.end())
      throw InputError(in_file(name, line, "edge"), "vertex " + std::to_string(id) + " is not in the file");
    return it->second;
  };
  problem.fixed.assign(problem.poses.size(), 0);
  for (const auto& [id, line] : raw.fixed) problem.fixed[index_of(id, line)] = 1;
  problem.information.clear();
  for (const RawEdge& e : raw.edges) {
    PoseGraphEdge edge;
    edge.from = index_of(e.from, e.line);
    edge.to = index_of(e.to, e.line);
    edge.T_from_to =
        problem.kind == PoseGraphKind::kSim3 ? e.measurement : Sim3(e.measurement.rigid());
    const PoseGraphInformation information = convert_information(e, problem.kind, meaning);
    if (problem.information.empty() || problem.information.back() != information)
      problem.information.push_back(information);
    edge.information = static_cast<int>(problem.information.size()) - 1;
    if (meaning == G2oInformation::kIsotropic && e.family == Family::kSe3 && problem.kind != PoseGraphKind::kSim3)
      graph.se3_information.push_back(e.information.topLeftCorner<6, 6>());
    edge.switchable = std::abs(edge.from - edge.to) > 1;
    problem.edges.push_back(edge);
  }
  if (problem.information.empty()) problem.information.push_back(PoseGraphInformation::Identity());
  if (graph.se3_information.size() != problem.edges.size()) graph.se3_information.clear();
  return graph;
}

G2oGraph read_g2o(const std::filesystem::path& path, std::optional<int> dof, G2oInformation meaning) {
  return parse_g2o(read_text_file(path), path, dof, meaning);
}

void write_g2o(const std::filesystem::path& path, const G2oGraph& graph, G2oInformation meaning) {
  const PoseGraphProblem& problem = graph.problem;
  const bool sim3 = problem.kind == PoseGraphKind::kSim3;
  const char* family = sim3 ? "SIM3:QUAT" : "SE3:QUAT";
  std::string text;
  char buffer[64];
  const auto put = [&](double value) {
    text.append(buffer, static_cast<std::size_t>(std::snprintf(buffer, sizeof buffer, " %.17g", value)));
  };
  const auto put_pose = [&](const Sim3& pose) {
    for (int i = 0; i < 3; ++i) put(pose.translation[i]);
    put(pose.rotation.x());
    put(pose.rotation.y());
    put(pose.rotation.z());
    put(pose.rotation.w());
    if (sim3) put(pose.scale);
  };
  for (std::size_t i = 0; i < problem.poses.size(); ++i) {
    text += std::string("VERTEX_") + family + " " + std::to_string(graph.ids.at(i));
    put_pose(problem.poses[i]);
    text += "\n";
    if (!problem.fixed.empty() && problem.fixed[i])
      text += "FIX " + std::to_string(graph.ids[i]) + "\n";
  }
  const int order[7] = {3, 4, 5, 0, 1, 2, 6};
  std::size_t edge_index = 0;
  for (const PoseGraphEdge& e : problem.edges) {
    text += std::string("EDGE_") + family + " " + std::to_string(graph.ids.at(e.from)) + " " +
            std::to_string(graph.ids.at(e.to));
    put_pose(e.T_from_to);
    PoseGraphInformation m = problem.information.at(e.information);
    if (problem.kind == PoseGraphKind::kYaw) {
      Matrix7d turn = Matrix7d::Identity();
      turn.block<3, 3>(3, 3) = e.T_from_to.rotation.toRotationMatrix();
      turn.block<3, 3>(0, 0) = turn.block<3, 3>(3, 3);
      m = turn.transpose() * m * turn;
    }
    const bool have_vector = problem.kind != PoseGraphKind::kSe3;
    const bool want_vector = sim3 || meaning != G2oInformation::kQuaternion;
    const double factor = have_vector == want_vector ? 1.0 : want_vector ? 0.5 : 2.0;
    m.topRows<3>() *= factor;
    m.leftCols<3>() *= factor;
    const int size = sim3 ? 7 : 6;
    const bool as_read = !sim3 && meaning == G2oInformation::kIsotropic && !graph.se3_information.empty();
    for (int r = 0; r < size; ++r)
      for (int c = r; c < size; ++c) put(as_read ? graph.se3_information.at(edge_index)(r, c) : m(order[r], order[c]));
    ++edge_index;
    text += "\n";
  }
  write_text_file(path, text);
}

}  // namespace fastloop::io
