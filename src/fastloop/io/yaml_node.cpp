#include "fastloop/io/yaml_node.hpp"

#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <limits>

#include "fastloop/core/error.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

/// Hand-written files round to four digits or so; anything worse is not a rotation.
constexpr double kRotationTolerance = 2e-3;
constexpr std::size_t kMaxItems = 4096;

/// OpenCV starts its files with "%YAML:1.0", which YAML does not know. Blanked, so that lines keep
/// their numbers.
std::string without_directives(std::string text) {
  if (text.rfind("\xEF\xBB\xBF", 0) == 0) text.replace(0, 3, "   ");
  const std::size_t begin = text.find_first_not_of(" \t\r\n");
  if (begin != std::string::npos && text[begin] == '%') {
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    std::fill(text.begin() + static_cast<std::ptrdiff_t>(begin),
              text.begin() + static_cast<std::ptrdiff_t>(end), ' ');
  }
  return text;
}

std::string joined(std::initializer_list<std::string_view> names) {
  std::string list;
  for (const std::string_view name : names) list += (list.empty() ? "" : ", ") + std::string(name);
  return list;
}

std::string size_rule(std::size_t min_size, std::size_t max_size) {
  std::string rule = std::to_string(min_size);
  if (max_size != min_size) rule += " to " + std::to_string(max_size);
  return "a list of " + rule + " numbers";
}

}  // namespace

YamlNode::YamlNode(YAML::Node node, std::string file, std::string key, int line)
    : node_(std::move(node)), file_(std::move(file)), key_(std::move(key)), line_(line) {}

YamlNode YamlNode::parse(const std::string& text, const std::string& file) {
  try {
    const YAML::Node root = YAML::Load(without_directives(text));
    if (!root.IsMap()) throw InputError(in_file(file), "holds no keys", "a YAML map");
    return YamlNode(root, file, "", 0);
  } catch (const YAML::Exception& e) {
    throw InputError(in_file(file, std::max(0, e.mark.line + 1)), "is not valid YAML: " + e.msg);
  }
}

YamlNode YamlNode::load(const std::string& path) {
  return parse(read_text_file(path), path);
}

YamlNode YamlNode::child(const YAML::Node& node, std::string key) const {
  const int line = node.Mark().line >= 0 ? node.Mark().line + 1 : line_;
  return YamlNode(node, file_, std::move(key), line);
}

void YamlNode::fail(const std::string& message, const std::string& expected) const {
  throw InputError({file_, line_, key_}, message, expected);
}

std::optional<YamlNode> YamlNode::find(const std::string& name) const {
  if (!is_map()) return std::nullopt;
  for (const auto& entry : node_)
    if (entry.first.IsScalar() && entry.first.Scalar() == name) {
      YamlNode value = child(entry.second, key_.empty() ? name : key_ + "." + name);
      value.line_ = entry.first.Mark().line + 1;  // the line of the key is what a person looks for
      return value;
    }
  return std::nullopt;
}

YamlNode YamlNode::required(const std::string& name, const std::string& expected) const {
  if (!is_map()) fail("is not a map", "keys such as " + name);
  if (auto value = find(name)) return *value;
  throw InputError({file_, line_, key_.empty() ? name : key_ + "." + name}, "is missing", expected);
}

std::vector<std::string> YamlNode::keys() const {
  std::vector<std::string> names;
  if (is_map())
    for (const auto& entry : node_)
      if (entry.first.IsScalar()) names.push_back(entry.first.Scalar());
  return names;
}

void YamlNode::allow_only(std::initializer_list<std::string_view> names) const {
  if (!is_map()) fail("is not a map", "the keys " + joined(names));
  std::vector<std::string> seen;
  for (const auto& entry : node_) {
    const std::string name = entry.first.IsScalar() ? entry.first.Scalar() : "?";
    const InputError::Where where{file_, entry.first.Mark().line + 1,
                                  key_.empty() ? name : key_ + "." + name};
    if (std::find(names.begin(), names.end(), name) == names.end())
      throw InputError(where, "is an unknown key", "one of " + joined(names));
    if (std::find(seen.begin(), seen.end(), name) != seen.end())
      throw InputError(where, "is given twice", "one value");
    seen.push_back(name);
  }
}

std::vector<YamlNode> YamlNode::items() const {
  if (!is_sequence()) fail("is not a list", "a list");
  if (node_.size() > kMaxItems) fail("is too long a list", "at most " + std::to_string(kMaxItems));
  std::vector<YamlNode> all;
  for (const auto& item : node_)
    all.push_back(child(item, key_ + "[" + std::to_string(all.size()) + "]"));
  return all;
}

std::string YamlNode::text() const {
  if (!node_.IsScalar()) fail("is not a single value", "a text");
  return node_.Scalar();
}

double YamlNode::number() const {
  if (!node_.IsScalar()) fail("is not a single value", "a number");
  const auto value = parse_number(node_.Scalar());
  if (!value) fail("'" + node_.Scalar().substr(0, 40) + "' is not a number", "a finite number");
  if (!std::isfinite(*value)) fail("is not finite", "a finite number");
  return *value;
}

double YamlNode::positive_number() const {
  const double value = number();
  if (value <= 0) fail("is not positive", "a number > 0");
  return value;
}

int YamlNode::integer() const {
  const double value = number();
  if (value != std::floor(value) || std::abs(value) > std::numeric_limits<int>::max())
    fail("is not a whole number", "a whole number");
  return static_cast<int>(value);
}

std::vector<double> YamlNode::numbers(std::size_t min_size, std::size_t max_size) const {
  std::vector<double> values;
  if (!is_sequence()) fail("is not a list", size_rule(min_size, max_size));
  for (const YamlNode& item : items()) {
    if (item.is_sequence()) {
      for (const YamlNode& inner : item.items()) values.push_back(inner.number());
    } else {
      values.push_back(item.number());
    }
  }
  if (values.size() < min_size || values.size() > max_size)
    fail("has " + std::to_string(values.size()) + " numbers", size_rule(min_size, max_size));
  return values;
}

SE3 YamlNode::transform() const {
  if (is_map()) return required("data", "16 numbers, row by row").transform();
  const std::vector<double> v = numbers(16, 16);
  const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> m(v.data());
  if ((m.row(3) - Eigen::RowVector4d(0, 0, 0, 1)).cwiseAbs().maxCoeff() > 1e-6)
    fail("has a wrong last row", "0, 0, 0, 1");
  const Matrix3d r = m.topLeftCorner<3, 3>();
  const double deviation = (r.transpose() * r - Matrix3d::Identity()).cwiseAbs().maxCoeff();
  if (!(deviation < kRotationTolerance) || r.determinant() <= 0)
    fail("is no rotation: its upper left 3x3 block is not orthonormal",
         "a 4x4 rigid transformation, row by row");
  const Eigen::JacobiSVD<Matrix3d> svd(r, Eigen::ComputeFullU | Eigen::ComputeFullV);
  return SE3(Matrix3d(svd.matrixU() * svd.matrixV().transpose()),
             Vector3d(m.topRightCorner<3, 1>()));
}

}  // namespace fastloop::io
