#include "fastloop/place/vocabulary.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <fstream>
#include <map>
#include <random>
#include <set>
#include <sstream>

#include "fastloop/core/error.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/place/vocabulary_io.hpp"
#include "fastloop/place/vocabulary_training.hpp"

namespace fastloop::place {
namespace {

namespace fs = std::filesystem;

Descriptor random_descriptor(std::mt19937& rng) {
  Descriptor d;
  for (auto& word : d.words) word = (static_cast<std::uint64_t>(rng()) << 32) | rng();
  return d;
}

Descriptor noisy(Descriptor d, int flips, std::mt19937& rng) {
  for (int i = 0; i < flips; ++i) {
    const unsigned bit = rng() % 256;
    d.words[bit / 64] ^= std::uint64_t{1} << (bit % 64);
  }
  return d;
}

/// Images of things with a few hundred appearances, each image with things of its own.
std::vector<std::vector<Descriptor>> random_images(int count, unsigned seed) {
  std::mt19937 rng(seed);
  std::vector<Descriptor> looks;
  for (int i = 0; i < 400; ++i) looks.push_back(random_descriptor(rng));
  std::vector<std::vector<Descriptor>> images(count);
  for (auto& image : images) {
    const unsigned from = rng() % 400;
    for (int i = 0; i < 120; ++i)
      image.push_back(noisy(looks[(from + rng() % 100) % 400], 20, rng));
  }
  return images;
}

VocabularyTree small_tree(const Executor& executor = Executor::cpu()) {
  TrainingOptions options;
  options.branching = 6;
  options.levels = 4;
  return train_vocabulary(executor, random_images(40, 1), options);
}

class Folder : public ::testing::Test {
 protected:
  Folder()
      : path_(fs::temp_directory_path() / ("fastloop_vocabulary_" + std::to_string(getpid()))) {
    fs::create_directories(path_);
  }
  ~Folder() override { fs::remove_all(path_); }
  fs::path path_;
};

TEST(VocabularyTraining, DoesNotDependOnTheExecutor) {
  const VocabularyTree a = small_tree(Executor::reference()), b = small_tree(Executor::cpu());
  EXPECT_EQ(a, b);
  EXPECT_EQ(a, small_tree(Executor::cpu()));
}

TEST(VocabularyTraining, TellsAppearancesApart) {
  const auto images = random_images(40, 1);
  const Vocabulary vocabulary(small_tree());
  EXPECT_GT(vocabulary.num_words(), 200u);
  // Two noisy views of one thing share their word far more often than views of two things.
  std::mt19937 rng(2);
  int same = 0, different = 0;
  for (int i = 0; i < 500; ++i) {
    const Descriptor a = images[rng() % 40][rng() % 120], b = images[rng() % 40][rng() % 120];
    same += vocabulary.word_of(a) == vocabulary.word_of(noisy(a, 8, rng));
    different += vocabulary.word_of(a) == vocabulary.word_of(b);
  }
  EXPECT_GT(same, 250);
  EXPECT_LT(different, 50);
}

TEST(VocabularyTraining, ChildrenAreTheMediansOfWhatTheyAttract) {
  const auto images = random_images(30, 3);
  TrainingOptions options;
  options.levels = 1;
  options.branching = 5;
  options.max_iterations = 1000;  // to convergence
  const VocabularyTree tree = train_vocabulary(Executor::cpu(), images, options);
  const Vocabulary vocabulary(tree);
  ASSERT_EQ(vocabulary.num_words(), 5u);
  std::vector<std::array<int, 256>> ones(5);
  std::vector<int> members(5);
  for (const auto& image : images)
    for (const Descriptor& d : image) {
      const std::uint32_t w = vocabulary.word_of(d);
      ++members[w];
      for (int b = 0; b < 256; ++b) ones[w][b] += d.words[b / 64] >> (b % 64) & 1;
    }
  for (int w = 0; w < 5; ++w)
    for (int b = 0; b < 256; ++b) {
      const bool bit = tree.descriptor[1 + w].words[b / 64] >> (b % 64) & 1;
      EXPECT_EQ(bit, 2 * ones[w][b] > members[w]);
    }
}

TEST(VocabularyTraining, WeightsAreInverseDocumentFrequencies) {
  const auto images = random_images(40, 1);
  const VocabularyTree tree = small_tree();
  const Vocabulary vocabulary(tree);
  std::map<std::uint32_t, std::set<std::size_t>> seen_in;
  for (std::size_t i = 0; i < images.size(); ++i)
    for (const Descriptor& d : images[i]) seen_in[vocabulary.word_of(d)].insert(i);
  std::uint32_t word = 0;
  for (std::size_t n = 1; n < tree.size(); ++n) {
    if (!tree.is_leaf(n)) {
      EXPECT_EQ(tree.weight[n], 0);
      continue;
    }
    const std::size_t with = std::max<std::size_t>(1, seen_in[word++].size());
    EXPECT_NEAR(tree.weight[n], std::log(40.0 / static_cast<double>(with)), 1e-6);
  }
}

TEST(VocabularyTraining, DegenerateInputs) {
  EXPECT_THROW(train_vocabulary(Executor::cpu(), {}), InvalidArgument);
  const std::vector<std::vector<Descriptor>> empty(3);
  EXPECT_THROW(train_vocabulary(Executor::cpu(), empty), InvalidArgument);
  // Equal descriptors everywhere: one word.
  const std::vector<std::vector<Descriptor>> equal(3, std::vector<Descriptor>(20));
  const VocabularyTree tree = train_vocabulary(Executor::cpu(), equal);
  EXPECT_EQ(Vocabulary(tree).num_words(), 1u);
  TrainingOptions options;
  options.branching = 1;
  EXPECT_THROW(train_vocabulary(Executor::cpu(), equal, options), InvalidArgument);
  options = {};
  options.levels = 0;
  EXPECT_THROW(train_vocabulary(Executor::cpu(), equal, options), InvalidArgument);
}

TEST(VocabularyTransform, VectorAndGroupsAgreeWithTheTree) {
  const VocabularyTree tree = small_tree();
  const Vocabulary vocabulary(tree);
  const auto image = random_images(5, 9)[2];
  const BagOfWords bag = vocabulary.transform(image);

  std::map<std::uint32_t, float> weight_of_word;
  for (std::size_t n = 1, w = 0; n < tree.size(); ++n)
    if (tree.is_leaf(n)) weight_of_word[static_cast<std::uint32_t>(w++)] = tree.weight[n];
  std::map<std::uint32_t, double> expected;
  double sum = 0;
  for (const Descriptor& d : image) {
    expected[vocabulary.word_of(d)] += weight_of_word[vocabulary.word_of(d)];
    sum += weight_of_word[vocabulary.word_of(d)];
  }
  std::erase_if(expected, [](const auto& e) { return e.second == 0; });
  ASSERT_EQ(bag.vector.size(), expected.size());
  std::size_t i = 0;
  for (const auto& [word, weight] : expected) {
    EXPECT_EQ(bag.vector.word[i], word);
    EXPECT_NEAR(bag.vector.weight[i++], weight / sum, 1e-6);
  }

  // A keypoint's group is the node of level two that the greedy descent passes.
  std::map<std::uint32_t, std::vector<std::uint16_t>> groups;
  for (std::size_t k = 0; k < image.size(); ++k) {
    if (weight_of_word[vocabulary.word_of(image[k])] == 0) continue;
    std::uint32_t node = 0;
    for (int level = 0; level < 2 && !tree.is_leaf(node); ++level) {
      std::uint32_t best = tree.first_child[node];
      for (std::uint32_t c = best; c < tree.first_child[node + 1]; ++c)
        if (hamming_distance(image[k], tree.descriptor[c]) <
            hamming_distance(image[k], tree.descriptor[best]))
          best = c;
      node = best;
    }
    groups[node].push_back(static_cast<std::uint16_t>(k));
  }
  ASSERT_EQ(bag.groups.node.size(), groups.size());
  std::size_t g = 0;
  for (const auto& [node, members] : groups) {
    EXPECT_EQ(bag.groups.node[g], node);
    const std::vector<std::uint16_t> found(bag.groups.indices.begin() + bag.groups.start[g],
                                           bag.groups.indices.begin() + bag.groups.start[g + 1]);
    EXPECT_EQ(found, members);
    ++g;
  }
  EXPECT_EQ(vocabulary.transform({}).vector.size(), 0u);
  EXPECT_EQ(vocabulary.transform({}).groups.start, std::vector<std::uint32_t>{0});
}

TEST(L1Score, IsOneMinusHalfTheDistance) {
  const Vocabulary vocabulary(small_tree());
  const auto images = random_images(12, 5);
  for (const auto& a : images)
    for (const auto& b : images) {
      const BowVector u = vocabulary.transform(a).vector, v = vocabulary.transform(b).vector;
      std::map<std::uint32_t, double> difference;
      for (std::size_t i = 0; i < u.size(); ++i) difference[u.word[i]] += u.weight[i];
      for (std::size_t i = 0; i < v.size(); ++i) difference[v.word[i]] -= v.weight[i];
      double distance = 0;
      for (const auto& [word, d] : difference) distance += std::abs(d);
      EXPECT_NEAR(l1_score(u, v), 1 - distance / 2, 1e-5);
      EXPECT_EQ(l1_score(u, v), l1_score(v, u));
    }
  EXPECT_EQ(l1_score({}, {}), 0);
}

TEST(VocabularyTree, BrokenTreesAreRejected) {
  const VocabularyTree good = small_tree();
  EXPECT_NO_THROW(Vocabulary{good});
  const auto rejected = [&](auto change) {
    VocabularyTree bad = good;
    change(bad);
    EXPECT_THROW(Vocabulary{bad}, InvalidArgument);
  };
  rejected([](VocabularyTree& t) { t = {}; });
  rejected([](VocabularyTree& t) { t.weight.pop_back(); });
  rejected([](VocabularyTree& t) { t.weight[3] = -1; });
  rejected([](VocabularyTree& t) { t.weight[3] = NAN; });
  rejected([](VocabularyTree& t) { t.first_child[0] = 0; });
  rejected([](VocabularyTree& t) { t.first_child.back() += 1; });
  rejected([](VocabularyTree& t) { std::swap(t.first_child[1], t.first_child[2]); });
}

TEST_F(Folder, BinaryRoundTripIsExact) {
  const VocabularyTree tree = small_tree();
  save_vocabulary(tree, path_ / "v.flvoc");
  EXPECT_EQ(load_vocabulary(path_ / "v.flvoc"), tree);
  EXPECT_EQ(load_any_vocabulary(path_ / "v.flvoc"), tree);
  EXPECT_THROW(save_vocabulary(tree, path_ / "absent" / "v.flvoc"), InputError);
  EXPECT_THROW(load_any_vocabulary(path_ / "absent"), InputError);
}

TEST_F(Folder, EveryDamagedByteAndEveryTruncationIsNoticed) {
  TrainingOptions options;
  options.branching = 3;
  options.levels = 2;
  save_vocabulary(train_vocabulary(Executor::cpu(), random_images(3, 1), options), path_ / "v");
  std::ifstream in(path_ / "v", std::ios::binary);
  const std::string bytes((std::istreambuf_iterator<char>(in)), {});
  const auto parse = [](const std::string& s) {
    return parse_vocabulary(std::as_bytes(std::span(s.data(), s.size())), "v");
  };
  ASSERT_NO_THROW(parse(bytes));
  for (std::size_t i = 0; i < bytes.size(); ++i) {
    std::string damaged = bytes;
    damaged[i] = static_cast<char>(damaged[i] ^ (1 << (i % 8)));
    EXPECT_THROW(parse(damaged), InputError) << i;
    EXPECT_THROW(parse(bytes.substr(0, i)), InputError) << i;
  }
  EXPECT_THROW(parse(bytes + "x"), InputError);
}

TEST_F(Folder, TextRoundTripIsExact) {
  const VocabularyTree tree = small_tree();
  save_vocabulary_text(tree, path_ / "v.txt");
  EXPECT_EQ(load_vocabulary_text(path_ / "v.txt"), tree);
  EXPECT_EQ(load_any_vocabulary(path_ / "v.txt"), tree);
}

std::string node_line(const std::string& start, int byte, const std::string& weight) {
  std::string line = start;
  for (int i = 0; i < 32; ++i) line += ' ' + std::to_string((byte + i) % 256);
  return line + ' ' + weight + '\n';
}

TEST_F(Folder, TextNodesMayComeDepthFirst) {
  // 1 and 4 below the root; 2, 3 below 1.
  std::ofstream(path_ / "v.txt") << "3 2 0 0 \r\n"
                                 << node_line("0 0", 10, "0") << node_line("1 1", 20, "0.5")
                                 << node_line("1 1", 30, "1.25e-1") << node_line("0 1", 40, "2")
                                 << "\n";
  const VocabularyTree tree = load_vocabulary_text(path_ / "v.txt");
  EXPECT_EQ(tree.branching, 3);
  EXPECT_EQ(tree.levels, 2);
  EXPECT_EQ(tree.first_child, (std::vector<std::uint32_t>{1, 3, 5, 5, 5, 5}));
  EXPECT_EQ(tree.weight, (std::vector<float>{0, 0, 2, 0.5, 0.125}));
  const auto first_byte = [&](std::size_t n) { return tree.descriptor[n].words[0] & 0xff; };
  const auto last_byte = [&](std::size_t n) { return tree.descriptor[n].words[3] >> 56; };
  EXPECT_EQ(first_byte(1), 10u);
  EXPECT_EQ(first_byte(2), 40u);
  EXPECT_EQ(first_byte(3), 20u);
  EXPECT_EQ(last_byte(4), 61u);
}

TEST_F(Folder, BrokenTextNamesTheLineAndTheField) {
  const std::string head = "3 2 0 0\n";
  const auto error = [&](const std::string& text) {
    std::ofstream(path_ / "v.txt") << text;
    try {
      load_vocabulary_text(path_ / "v.txt");
    } catch (const InputError& e) {
      return std::to_string(e.where().line) + ":" + e.where().key;
    }
    return std::string("accepted");
  };
  EXPECT_EQ(error(head + node_line("0 1", 1, "1")), "accepted");
  EXPECT_EQ(error(""), "0:");
  EXPECT_EQ(error(head), "1:");
  EXPECT_EQ(error("1 2 0 0\n"), "1:k");
  EXPECT_EQ(error("3 x 0 0\n"), "1:L");
  EXPECT_EQ(error("3 2 1 0\n"), "1:scoring");
  EXPECT_EQ(error("3 2 0 2\n"), "1:weighting");
  EXPECT_EQ(error("3 2 0 0 7\n"), "1:");
  EXPECT_EQ(error(head + node_line("1 1", 1, "1")), "2:parent");
  EXPECT_EQ(error(head + node_line("0 2", 1, "1")), "2:isLeaf");
  EXPECT_EQ(error(head + "0 1 1 2 256\n"), "2:descriptor");
  EXPECT_EQ(error(head + "0 1 1 2 3\n"), "2:descriptor");
  EXPECT_EQ(error(head + node_line("0 1", 1, "")), "2:weight");
  EXPECT_EQ(error(head + node_line("0 1", 1, "-1")), "2:weight");
  EXPECT_EQ(error(head + node_line("0 1", 1, "nan")), "2:weight");
  EXPECT_EQ(error(head + node_line("0 1", 1, "1 1")), "2:");
  EXPECT_EQ(error(head + node_line("0 0", 1, "1")), "2:isLeaf");
  EXPECT_EQ(error(head + node_line("0 1", 1, "1") + node_line("1 1", 1, "1")), "2:isLeaf");
  std::string many = head;
  for (int i = 0; i < 4; ++i) many += node_line("0 1", i, "1");
  EXPECT_EQ(error(many), "1:k");
}

TEST(DefaultVocabulary, IsComplete) {
  const Vocabulary& vocabulary = default_vocabulary();
  EXPECT_GT(vocabulary.num_words(), 10000u);
  std::size_t nodes_at_level_2 = 0;
  const VocabularyTree& tree = vocabulary.tree();
  for (std::uint32_t n = tree.first_child[0]; n < tree.first_child[1]; ++n)
    nodes_at_level_2 += tree.first_child[n + 1] - tree.first_child[n];
  EXPECT_GT(nodes_at_level_2, 50u);
  EXPECT_EQ(&vocabulary, &default_vocabulary());
}

}  // namespace
}  // namespace fastloop::place
