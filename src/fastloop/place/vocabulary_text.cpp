#include <charconv>
#include <cmath>
#include <fstream>
#include <string>
#include <string_view>

#include "fastloop/core/error.hpp"
#include "fastloop/place/vocabulary_io.hpp"

namespace fastloop::place {
namespace {

constexpr int kBytes = 32;

int byte_of(const Descriptor& d, int i) {
  return static_cast<int>(d.words[i / 8] >> (8 * (i % 8)) & 0xff);
}

void set_byte(Descriptor& d, int i, int value) {
  d.words[i / 8] |= static_cast<std::uint64_t>(value) << (8 * (i % 8));
}

/// Numbers of one line, separated by blanks.
class LineReader {
 public:
  LineReader(const std::string& file, int line, std::string_view text)
      : where_{file, line, ""}, text_(text) {}

  template <class T>
  T next(const char* key, const char* expected) {
    skip_blanks();
    T value{};
    const auto [end, error] = std::from_chars(text_.data(), text_.data() + text_.size(), value);
    if (error != std::errc() || end == text_.data()) fail(key, expected);
    text_.remove_prefix(static_cast<std::size_t>(end - text_.data()));
    if (!text_.empty() && !blank(text_.front())) fail(key, expected);
    return value;
  }

  long next_in(const char* key, long low, long high, const char* expected) {
    const long value = next<long>(key, expected);
    if (value < low || value > high) fail(key, expected);
    return value;
  }

  void expect_end() {
    skip_blanks();
    if (!text_.empty()) fail("", "the end of the line");
  }

  [[noreturn]] void fail(const char* key, const char* expected) const {
    throw InputError({where_.file, where_.line, key}, "cannot be used in a vocabulary", expected);
  }

 private:
  static bool blank(char c) { return c == ' ' || c == '\t' || c == '\r'; }
  void skip_blanks() {
    while (!text_.empty() && blank(text_.front())) text_.remove_prefix(1);
  }
  InputError::Where where_;
  std::string_view text_;
};

/// Nodes in the order of the file, which need not be breadth-first.
struct TextTree {
  int branching = 0, levels = 0;
  std::vector<std::uint32_t> parent;
  std::vector<Descriptor> descriptor;
  std::vector<float> weight;
  std::vector<std::uint8_t> leaf;
};

void read_header(LineReader line, TextTree& tree) {
  tree.branching = static_cast<int>(line.next_in("k", 2, 255, "a number of children in 2..255"));
  tree.levels = static_cast<int>(line.next_in("L", 1, 100, "a number of levels in 1..100"));
  line.next_in("scoring", 0, 0, "0 (L1 score)");
  line.next_in("weighting", 0, 0, "0 (tf-idf)");
  line.expect_end();
}

void read_node(LineReader line, TextTree& tree) {
  const long own = static_cast<long>(tree.parent.size());
  tree.parent.push_back(static_cast<std::uint32_t>(
      line.next_in("parent", 0, own - 1, "the number of an earlier node")));
  tree.leaf.push_back(line.next_in("isLeaf", 0, 1, "0 or 1") == 1);
  Descriptor d;
  for (int i = 0; i < kBytes; ++i)
    set_byte(d, i, static_cast<int>(line.next_in("descriptor", 0, 255, "32 bytes in 0..255")));
  tree.descriptor.push_back(d);
  const double weight = line.next<double>("weight", "a weight >= 0");
  if (!std::isfinite(weight) || weight < 0) line.fail("weight", "a weight >= 0");
  tree.weight.push_back(static_cast<float>(weight));
  line.expect_end();
}

/// Renumbers the nodes breadth-first; children keep their order.
VocabularyTree breadth_first(const TextTree& text, const std::string& file) {
  const std::size_t n = text.parent.size();
  std::vector<std::uint32_t> start(n + 1, 0), children(n - 1);
  for (std::size_t i = 1; i < n; ++i) ++start[text.parent[i] + 1];
  for (std::size_t i = 0; i < n; ++i) start[i + 1] += start[i];
  std::vector<std::uint32_t> fill(start.begin(), start.end() - 1);
  for (std::size_t i = 1; i < n; ++i)
    children[fill[text.parent[i]]++] = static_cast<std::uint32_t>(i);

  VocabularyTree tree;
  tree.branching = text.branching;
  std::vector<std::uint32_t> order{0}, depth{0};
  for (std::size_t at = 0; at < order.size(); ++at) {
    const std::uint32_t node = order[at];
    const bool leaf = start[node] == start[node + 1];
    if (start[node + 1] - start[node] > static_cast<std::uint32_t>(text.branching))
      throw InputError({file, static_cast<int>(node) + 1, "k"}, "a node has too many children",
                       "at most " + std::to_string(text.branching));
    if (node > 0 && leaf != (text.leaf[node] != 0))
      throw InputError(
          {file, static_cast<int>(node) + 1, "isLeaf"},
          leaf ? "a node without children is not called a leaf" : "a leaf has children");
    tree.levels = std::max(tree.levels, static_cast<int>(depth[at]));
    tree.first_child.push_back(static_cast<std::uint32_t>(order.size()));
    tree.descriptor.push_back(text.descriptor[node]);
    tree.weight.push_back(leaf ? text.weight[node] : 0);
    for (std::uint32_t c = start[node]; c < start[node + 1]; ++c) {
      order.push_back(children[c]);
      depth.push_back(depth[at] + 1);
    }
  }
  tree.first_child.push_back(static_cast<std::uint32_t>(order.size()));
  return tree;
}

}  // namespace

VocabularyTree load_vocabulary_text(const std::filesystem::path& path) {
  const std::string file = path.string();
  std::ifstream in(path);
  if (!in) throw InputError({file, 0, ""}, "cannot open the vocabulary");
  TextTree text;
  std::string line;
  int number = 0;
  while (std::getline(in, line)) {
    ++number;
    if (line.find_first_not_of(" \t\r") == std::string::npos) continue;
    if (text.parent.empty()) {
      read_header(LineReader(file, number, line), text);
      text.parent.push_back(0);
      text.leaf.push_back(0);
      text.descriptor.emplace_back();
      text.weight.push_back(0);
    } else {
      read_node(LineReader(file, number, line), text);
    }
  }
  if (text.parent.size() < 2)
    throw InputError({file, number, ""}, "the vocabulary has no words", "\"k L 0 0\" and nodes");
  return breadth_first(text, file);
}

void save_vocabulary_text(const VocabularyTree& tree, const std::filesystem::path& path) {
  const Vocabulary checked(tree);  // throws when it is not a tree
  std::ofstream out(path);
  out << tree.branching << ' ' << tree.levels << " 0 0\n";
  std::vector<std::uint32_t> parent(tree.size(), 0);
  for (std::size_t n = 0; n < tree.size(); ++n)
    for (std::uint32_t c = tree.first_child[n]; c < tree.first_child[n + 1]; ++c)
      parent[c] = static_cast<std::uint32_t>(n);
  std::array<char, 32> number;
  for (std::size_t n = 1; n < tree.size(); ++n) {
    std::string line = std::to_string(parent[n]) + (tree.is_leaf(n) ? " 1" : " 0");
    for (int i = 0; i < kBytes; ++i) line += ' ' + std::to_string(byte_of(tree.descriptor[n], i));
    const auto end =
        std::to_chars(number.data(), number.data() + number.size(), tree.weight[n]).ptr;
    line += ' ';
    line.append(number.data(), end);
    out << line << '\n';
  }
  out.close();
  if (!out) throw InputError({path.string(), 0, ""}, "cannot write the vocabulary");
}

}  // namespace fastloop::place
