#pragma once

#include <yaml-cpp/yaml.h>

#include <initializer_list>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "fastloop/geometry/se3.hpp"

namespace fastloop::io {

/// A YAML value that knows its file, line and full key ("cameras[0].intrinsics"), so that every
/// complaint about it can say where it is. All accessors throw InputError when the value is not
/// what is asked for.
///
/// Numbers must be finite. The OpenCV dialect ("%YAML:1.0", "!!opencv-matrix") is understood.
class YamlNode {
 public:
  /// @param file  name used in messages; nothing is read from it
  static YamlNode parse(const std::string& text, const std::string& file);
  static YamlNode load(const std::string& path);

  bool is_map() const { return node_.IsMap(); }
  bool is_sequence() const { return node_.IsSequence(); }
  const std::string& file() const { return file_; }
  const std::string& key() const { return key_; }
  int line() const { return line_; }

  /// Value of a key of this map, if it is there.
  std::optional<YamlNode> find(const std::string& name) const;
  YamlNode required(const std::string& name, const std::string& expected) const;
  bool has(const std::string& name) const { return find(name).has_value(); }
  /// Keys of this map in the order of the file.
  std::vector<std::string> keys() const;
  /// Throws when this is not a map, has a key outside the list, or has a key twice.
  void allow_only(std::initializer_list<std::string_view> names) const;

  std::vector<YamlNode> items() const;

  std::string text() const;
  double number() const;
  double positive_number() const;
  int integer() const;
  /// A list of numbers with a size between min_size and max_size; nested lists are read row by row.
  std::vector<double> numbers(std::size_t min_size, std::size_t max_size) const;
  /// Rigid transformation: 16 numbers row by row, a 4x4 list of lists, or a map with `data`.
  SE3 transform() const;

  [[noreturn]] void fail(const std::string& message, const std::string& expected = "") const;

 private:
  YamlNode(YAML::Node node, std::string file, std::string key, int line);
  YamlNode child(const YAML::Node& node, std::string key) const;

  YAML::Node node_;
  std::string file_, key_;
  int line_ = 0;
};

}  // namespace fastloop::io
