#include "fastloop/eval/sequence_list.hpp"

#include <algorithm>
#include <set>

#include "fastloop/io/text.hpp"
#include "fastloop/io/yaml_node.hpp"

namespace fastloop::eval {
namespace {

namespace fs = std::filesystem;

SequenceKind parse_kind(const io::YamlNode& node) {
  const std::string text = node.text();
  for (const auto kind : {SequenceKind::kReal, SequenceKind::kHalfReal, SequenceKind::kSimulated})
    if (text == to_string(kind)) return kind;
  node.fail("unknown kind '" + text + "'", "real, half-real or simulated");
}

bool parse_flag(const io::YamlNode& node) {
  const std::string text = node.text();
  if (text != "true" && text != "false") node.fail("not a yes or no", "true or false");
  return text == "true";
}

SequenceSource parse_source(const io::YamlNode& node) {
  node.allow_only({"kind", "folders", "simulate"});
  SequenceSource source;
  source.kind = parse_kind(node.required("kind", "real, half-real or simulated"));
  for (const io::YamlNode& folder : node.required("folders", "a list of names").items())
    source.folders.push_back(folder.text());
  if (const auto simulate = node.find("simulate")) {
    simulate->allow_only({"world", "camera", "seconds"});
    SimulationRecipe recipe;
    recipe.world = simulate->required("world", "a world of fastloop simulate").text();
    if (const auto camera = simulate->find("camera")) recipe.camera = camera->text();
    if (const auto seconds = simulate->find("seconds")) recipe.seconds = seconds->positive_number();
    source.simulate = recipe;
  }
  return source;
}

SequenceRow parse_row(const io::YamlNode& node) {
  node.allow_only({"name", "group", "paper", "mode", "sources"});
  SequenceRow row;
  row.name = node.required("name", "a word").text();
  row.group = node.required("group", "a heading").text();
  if (const auto paper = node.find("paper")) row.paper = parse_flag(*paper);
  if (const auto mode = node.find("mode")) row.mode = mode->text();
  for (const io::YamlNode& source : node.required("sources", "a list").items())
    row.sources.push_back(parse_source(source));
  return row;
}

/// Number of components that match when the path ends with this relative name; 0 when it does not.
std::size_t matching_tail(const fs::path& path, const fs::path& name) {
  const std::vector<fs::path> parts(path.begin(), path.end()), tail(name.begin(), name.end());
  if (tail.size() > parts.size() || !std::equal(tail.rbegin(), tail.rend(), parts.rbegin()))
    return 0;
  return tail.size();
}

SequenceKind kind_by_marker(const fs::path& folder) {
  std::error_code none;
  if (!fs::exists(folder / "simulation.txt", none)) return SequenceKind::kUnknown;
  const std::string text = io::read_text_file(folder / "simulation.txt");
  return text.find("motion recorded") == std::string::npos ? SequenceKind::kSimulated
                                                           : SequenceKind::kHalfReal;
}

}  // namespace

const char* to_string(SequenceKind kind) {
  switch (kind) {
    case SequenceKind::kReal:
      return "real";
    case SequenceKind::kHalfReal:
      return "half-real";
    case SequenceKind::kSimulated:
      return "simulated";
    case SequenceKind::kUnknown:
      break;
  }
  return "unknown";
}

std::vector<SequenceRow> parse_sequences(const std::string& text, const std::string& file) {
  const io::YamlNode root = io::YamlNode::parse(text, file);
  root.allow_only({"sequences"});
  std::vector<SequenceRow> rows;
  std::set<std::string> names;
  for (const io::YamlNode& node : root.required("sequences", "a list of rows").items()) {
    rows.push_back(parse_row(node));
    if (!names.insert(rows.back().name).second) node.fail("'" + rows.back().name + "' comes twice");
  }
  return rows;
}

std::optional<LocatedSequence> locate(const SequenceRow& row, std::span<const fs::path> roots) {
  std::error_code none;
  for (const SequenceSource& source : row.sources)
    for (const fs::path& root : roots)
      for (const std::string& name : source.folders)
        if (fs::is_directory(root / name, none))
          return LocatedSequence{source.kind, root / name, source.simulate};
  for (const SequenceSource& source : row.sources)
    if (source.simulate) return LocatedSequence{source.kind, {}, source.simulate};
  return std::nullopt;
}

NamedFolder classify(const fs::path& folder, std::span<const SequenceRow> rows) {
  std::error_code none;
  fs::path path = fs::absolute(folder, none).lexically_normal();
  if (path.filename().empty()) path = path.parent_path();
  NamedFolder best;
  std::size_t longest = 0;
  for (const SequenceRow& row : rows)
    for (const SequenceSource& source : row.sources)
      for (const std::string& name : source.folders)
        if (const std::size_t n = matching_tail(path, name); n > longest) {
          longest = n;
          best = {row, source.kind};
        }
  if (longest == 0) {
    best.row.name = path.filename().string();
    best.row.group = "other";
    best.kind = kind_by_marker(path);
  }
  return best;
}

}  // namespace fastloop::eval
