// Place recognition: from descriptors to words, and the query of a database, with the vocabulary
// that ships.
#include <benchmark/benchmark.h>

#include <random>

#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/place/inverted_index.hpp"

namespace fastloop::place {
namespace {

/// Descriptors near random words, so that they spread over the vocabulary as real ones do.
std::vector<Descriptor> descriptors(std::mt19937& rng, int n) {
  const VocabularyTree& tree = default_vocabulary().tree();
  std::vector<Descriptor> result;
  while (static_cast<int>(result.size()) < n) {
    const std::size_t node = 1 + rng() % (tree.size() - 1);
    if (!tree.is_leaf(node)) continue;
    Descriptor d = tree.descriptor[node];
    for (int i = 0; i < 20; ++i) d.words[rng() % 4] ^= std::uint64_t{1} << (rng() % 64);
    result.push_back(d);
  }
  return result;
}

void transform(benchmark::State& state) {
  std::mt19937 rng(1);
  const auto d = descriptors(rng, static_cast<int>(state.range(0)));
  for (auto _ : state) benchmark::DoNotOptimize(default_vocabulary().transform(d));
}
BENCHMARK(transform)->Arg(1200)->Unit(benchmark::kMillisecond);

/// Keyframes in a row; each shares a third of its features with the one before.
void query(benchmark::State& state) {
  std::mt19937 rng(1);
  InvertedIndex index(default_vocabulary().num_words());
  const auto keyframes = static_cast<std::uint32_t>(state.range(0));
  auto d = descriptors(rng, 1200);
  BowVector bow;
  for (std::uint32_t k = 0; k < keyframes; ++k) {
    const auto fresh = descriptors(rng, 800);
    std::copy(fresh.begin(), fresh.end(), d.begin());
    std::rotate(d.begin(), d.begin() + 400, d.end());
    bow = default_vocabulary().transform(d).vector;
    index.insert(KeyframeId(k), bow);
  }
  const auto neighbours = [&](KeyframeId id) {
    std::vector<KeyframeId> near;
    for (std::uint32_t i = 1; i <= 5; ++i)
      for (const std::uint32_t k : {id.value() - i, id.value() + i})
        if (k < keyframes) near.emplace_back(k);
    return near;
  };
  for (auto _ : state) benchmark::DoNotOptimize(index.query(bow, {}, neighbours));
}
BENCHMARK(query)->Arg(300)->Arg(3000)->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace fastloop::place
