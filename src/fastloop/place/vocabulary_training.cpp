#include "fastloop/place/vocabulary_training.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <string>

#include "fastloop/core/error.hpp"
#include "fastloop/features/hamming.hpp"

namespace fastloop::place {
namespace {

/// SplitMix64 (Steele, Lea and Flood, 2014): the same numbers on every platform.
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  std::uint64_t next() {
    std::uint64_t z = (state_ += 0x9e3779b97f4a7c15ull);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return z ^ (z >> 31);
  }

 private:
  std::uint64_t state_;
};

/// Counts the ones at each of the 256 positions of many descriptors. The counters are stored as bit
/// planes, so that adding a descriptor costs a few word operations instead of 256 additions.
class BitCounter {
 public:
  void add(const Descriptor& d) {
    ++count_;
    for (int w = 0; w < 4; ++w) {
      std::uint64_t carry = d.words[w];
      for (int p = 0; carry != 0 && p < kPlanes; ++p) {
        const std::uint64_t both = planes_[w][p] & carry;
        planes_[w][p] ^= carry;
        carry = both;
      }
    }
  }

  /// One where more than half of the descriptors have a one.
  Descriptor majority() const {
    Descriptor d;
    for (int bit = 0; bit < 256; ++bit) {
      std::uint64_t ones = 0;
      for (int p = 0; p < kPlanes; ++p) ones |= (planes_[bit / 64][p] >> (bit % 64) & 1) << p;
      if (2 * ones > count_) d.words[bit / 64] |= std::uint64_t{1} << (bit % 64);
    }
    return d;
  }

  std::uint64_t count() const { return count_; }

 private:
  static constexpr int kPlanes = 32;  // up to 4 billion descriptors
  std::array<std::array<std::uint64_t, kPlanes>, 4> planes_{};
  std::uint64_t count_ = 0;
};

/// First centres by k-means++: each new one is drawn with a probability proportional to the squared
/// distance from the nearest so far. Fewer than k when there are fewer distinct descriptors.
std::vector<Descriptor> first_centres(std::span<const Descriptor> data, int k, Random& random) {
  std::vector<Descriptor> centres{data[random.next() % data.size()]};
  std::vector<std::uint32_t> nearest(data.size(), 256 * 256);
  std::vector<std::uint16_t> distance(data.size());
  while (static_cast<int>(centres.size()) < k) {
    hamming_distances(centres.back(), data, distance.data());
    std::uint64_t total = 0;
    for (std::size_t i = 0; i < data.size(); ++i) {
      nearest[i] = std::min(nearest[i], std::uint32_t{distance[i]} * distance[i]);
      total += nearest[i];
    }
    if (total == 0) break;
    std::uint64_t at = random.next() % total;
    std::size_t chosen = 0;
    while (at >= nearest[chosen]) at -= nearest[chosen++];
    centres.push_back(data[chosen]);
  }
  return centres;
}

struct Clusters {
  std::vector<Descriptor> centres;
  std::vector<std::uint8_t> assignment;  ///< [descriptors]
};

Clusters cluster(std::span<const Descriptor> data, const TrainingOptions& options, Random& random) {
  Clusters c{first_centres(data, options.branching, random),
             std::vector<std::uint8_t>(data.size(), 255)};
  for (int iteration = 0; iteration <= options.max_iterations; ++iteration) {
    bool changed = false;
    for (std::size_t i = 0; i < data.size(); ++i) {
      const auto nearest =
          static_cast<std::uint8_t>(nearest_descriptor(data[i], c.centres).position);
      changed |= nearest != c.assignment[i];
      c.assignment[i] = nearest;
    }
    if (!changed || iteration == options.max_iterations) break;
    std::vector<BitCounter> counters(c.centres.size());
    for (std::size_t i = 0; i < data.size(); ++i) counters[c.assignment[i]].add(data[i]);
    for (std::size_t k = 0; k < counters.size(); ++k)
      if (counters[k].count() > 0) c.centres[k] = counters[k].majority();
  }
  return c;
}

/// A node to be split: its descriptors are data[begin, end).
struct OpenNode {
  std::size_t begin, end;
};

/// What splitting a node gave; `sizes` and `centres` leave out empty clusters.
struct Split {
  std::vector<Descriptor> centres;
  std::vector<std::size_t> sizes;
};

Split split_node(std::span<Descriptor> data, const TrainingOptions& options, std::uint64_t seed) {
  if (data.size() < static_cast<std::size_t>(options.min_to_split)) return {};
  Random random(seed);
  const Clusters c = cluster(data, options, random);
  std::vector<std::vector<Descriptor>> parts(c.centres.size());
  for (std::size_t i = 0; i < data.size(); ++i) parts[c.assignment[i]].push_back(data[i]);
  Split split;
  auto out = data.begin();
  for (std::size_t k = 0; k < parts.size(); ++k) {
    if (parts[k].empty()) continue;
    out = std::copy(parts[k].begin(), parts[k].end(), out);
    split.centres.push_back(c.centres[k]);
    split.sizes.push_back(parts[k].size());
  }
  if (split.sizes.size() == 1) return {};  // nothing to tell apart
  return split;
}

/// Splits the nodes of one level and appends their children, which become the next level.
std::vector<OpenNode> grow_level(const Executor& executor, std::vector<Descriptor>& data,
                                 const std::vector<OpenNode>& open, int level,
                                 const TrainingOptions& options, VocabularyTree& tree) {
  std::vector<Split> splits(open.size());
  executor.for_ranges(open.size(), 1, [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) {
      const std::span<Descriptor> part(data.data() + open[i].begin, open[i].end - open[i].begin);
      Random random(options.seed ^ (static_cast<std::uint64_t>(level) << 40 | i));
      splits[i] = split_node(part, options, random.next());
    }
  });
  std::vector<OpenNode> next;
  for (std::size_t i = 0; i < open.size(); ++i) {
    tree.first_child.push_back(static_cast<std::uint32_t>(tree.descriptor.size()));
    std::size_t begin = open[i].begin;
    for (std::size_t k = 0; k < splits[i].sizes.size(); ++k) {
      tree.descriptor.push_back(splits[i].centres[k]);
      next.push_back({begin, begin + splits[i].sizes[k]});
      begin += splits[i].sizes[k];
    }
  }
  if (!next.empty()) tree.levels = level + 1;
  return next;
}

}  // namespace

void TrainingOptions::validate() const {
  const auto require = [](bool ok, const char* field) {
    if (!ok) throw InvalidArgument(std::string("vocabulary training: ") + field);
  };
  require(branching >= 2 && branching <= 255, "branching must be in 2..255");
  require(levels >= 1 && levels <= 10, "levels must be in 1..10");
  require(min_to_split >= 2, "min_to_split must be at least 2");
  require(max_iterations >= 1, "max_iterations must be at least 1");
}

VocabularyTree train_vocabulary(const Executor& executor,
                                std::span<const std::vector<Descriptor>> images,
                                const TrainingOptions& options) {
  options.validate();
  std::vector<Descriptor> data;
  for (const auto& image : images) data.insert(data.end(), image.begin(), image.end());
  if (data.empty()) throw InvalidArgument("vocabulary training: no descriptors");

  VocabularyTree tree;
  tree.branching = options.branching;
  tree.descriptor.emplace_back();
  std::vector<OpenNode> open{{0, data.size()}};
  for (int level = 0; level < options.levels && !open.empty(); ++level) {
    open = grow_level(executor, data, open, level, options, tree);
    if (level == 0 && open.empty()) {  // all descriptors are equal: one word
      tree.first_child = {1};
      tree.descriptor.push_back(data[0]);
      tree.levels = 1;
      open = {{0, data.size()}};
      break;
    }
  }
  tree.first_child.resize(tree.size() + 1, static_cast<std::uint32_t>(tree.size()));
  set_inverse_document_frequencies(tree, images);
  return tree;
}

void set_inverse_document_frequencies(VocabularyTree& tree,
                                      std::span<const std::vector<Descriptor>> images) {
  tree.weight.assign(tree.size(), 0);
  const Vocabulary words(tree);
  std::vector<std::uint32_t> images_with(words.num_words(), 0);
  std::vector<std::uint32_t> last_image(words.num_words(), 0);
  for (std::size_t i = 0; i < images.size(); ++i)
    for (const Descriptor& d : images[i]) {
      const std::uint32_t word = words.word_of(d);
      if (last_image[word] == i + 1) continue;
      last_image[word] = static_cast<std::uint32_t>(i + 1);
      ++images_with[word];
    }
  std::size_t word = 0;
  for (std::size_t n = 1; n < tree.size(); ++n) {
    if (!tree.is_leaf(n)) continue;
    const double with = std::max<std::uint32_t>(1, images_with[word++]);
    tree.weight[n] = static_cast<float>(std::log(static_cast<double>(images.size()) / with));
  }
}

}  // namespace fastloop::place
