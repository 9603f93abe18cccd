#include "fastloop/place/inverted_index.hpp"

#include <algorithm>

#include "fastloop/core/error.hpp"

namespace fastloop::place {
namespace {

constexpr std::uint32_t kFirstRoom = 4;
constexpr std::size_t kMinPoolToPack = 4096;
constexpr std::size_t kAhead = 8;  // words

}  // namespace

InvertedIndex::InvertedIndex(std::size_t num_words) : lists_(num_words) {}

void InvertedIndex::insert(KeyframeId keyframe, const BowVector& bow) {
  if (slot_.contains(keyframe)) throw InvalidArgument("InvertedIndex: keyframe inserted twice");
  for (const std::uint32_t word : bow.word)
    if (word >= lists_.size()) throw InvalidArgument("InvertedIndex: word out of range");
  std::uint32_t slot;
  if (free_slots_.empty()) {
    slot = static_cast<std::uint32_t>(entries_.size());
    entries_.emplace_back();
  } else {
    slot = free_slots_.back();
    free_slots_.pop_back();
  }
  entries_[slot] = {keyframe, bow.word};
  slot_.emplace(keyframe, slot);
  for (std::size_t i = 0; i < bow.size(); ++i) {
    ask_ahead(bow, i);
    append(bow.word[i], {slot, bow.weight[i]});
  }
}

/// Neither the lists nor what they name are in the caches when a keyframe comes.
void InvertedIndex::ask_ahead(const BowVector& bow, std::size_t i) const {
  if (i + 2 * kAhead < bow.size()) __builtin_prefetch(&lists_[bow.word[i + 2 * kAhead]]);
  if (i + kAhead >= bow.size()) return;
  const List& list = lists_[bow.word[i + kAhead]];
  __builtin_prefetch(pool_.data() + list.begin);
  __builtin_prefetch(pool_.data() + list.begin + list.size);
}

void InvertedIndex::append(std::uint32_t word, Posting posting) {
  List& list = lists_[word];
  if (list.size == list.room) {
    const std::uint32_t room = std::max(kFirstRoom, 2 * list.room);
    const std::size_t begin = pool_.size();
    pool_.resize(begin + room);
    std::copy_n(pool_.begin() + list.begin, list.size, pool_.begin() + static_cast<long>(begin));
    unused_ += list.room;
    list.begin = static_cast<std::uint32_t>(begin);
    list.room = room;
  }
  pool_[list.begin + list.size++] = posting;
  if (pool_.size() > kMinPoolToPack && 2 * unused_ > pool_.size()) pack();
}

void InvertedIndex::pack() {
  std::vector<Posting> packed;
  packed.reserve(pool_.size() - unused_);
  for (List& list : lists_) {
    const auto from = pool_.begin() + list.begin;
    list.begin = static_cast<std::uint32_t>(packed.size());
    packed.insert(packed.end(), from, from + list.room);
  }
  pool_ = std::move(packed);
  unused_ = 0;
}

bool InvertedIndex::erase(KeyframeId keyframe) {
  const auto it = slot_.find(keyframe);
  if (it == slot_.end()) return false;
  const std::uint32_t slot = it->second;
  for (const std::uint32_t word : entries_[slot].words) {
    List& list = lists_[word];
    const auto begin = pool_.begin() + list.begin;
    const auto found =
        std::find_if(begin, begin + list.size, [&](const Posting& p) { return p.slot == slot; });
    *found = *(begin + --list.size);  // no result depends on the order of a list
  }
  entries_[slot] = {};
  free_slots_.push_back(slot);
  slot_.erase(it);
  return true;
}

InvertedIndex::Tally InvertedIndex::tally(const BowVector& bow,
                                          std::span<const KeyframeId> excluded) const {
  Tally t{std::vector<std::int32_t>(entries_.size(), 0), std::vector<float>(entries_.size(), 0)};
  for (const std::uint32_t word : bow.word)
    if (word >= lists_.size()) throw InvalidArgument("InvertedIndex: word out of range");
  // Query words ascend, so every score is summed in the order of l1_score.
  for (std::size_t i = 0; i < bow.size(); ++i) {
    ask_ahead(bow, i);
    const List& list = lists_[bow.word[i]];
    for (std::uint32_t p = list.begin; p < list.begin + list.size; ++p) {
      ++t.shared[pool_[p].slot];
      t.score[pool_[p].slot] += std::min(bow.weight[i], pool_[p].weight);
    }
  }
  for (const KeyframeId id : excluded)
    if (const auto it = slot_.find(id); it != slot_.end()) t.shared[it->second] = 0;
  return t;
}

PlaceCandidate InvertedIndex::gather(std::uint32_t slot, const Tally& tally,
                                     const Covisibles& covisibles) const {
  std::vector<KeyframeId> group = covisibles(entries_[slot].keyframe);
  group.push_back(entries_[slot].keyframe);
  // Ascending ids: the sum does not depend on the order in which neighbours are named.
  std::sort(group.begin(), group.end());
  group.erase(std::unique(group.begin(), group.end()), group.end());
  PlaceCandidate candidate;
  for (const KeyframeId id : group) {
    const auto it = slot_.find(id);
    if (it == slot_.end() || tally.shared[it->second] == 0) continue;
    const float score = tally.score[it->second];
    candidate.group_score += score;
    if (candidate.keyframe.valid() && score <= candidate.score) continue;
    candidate.keyframe = id;
    candidate.score = score;
    candidate.shared_words = tally.shared[it->second];
  }
  return candidate;
}

std::vector<PlaceCandidate> InvertedIndex::query(const BowVector& bow,
                                                 std::span<const KeyframeId> excluded,
                                                 const Covisibles& covisibles,
                                                 const QueryOptions& options) const {
  const Tally t = tally(bow, excluded);
  const auto most = std::max_element(t.shared.begin(), t.shared.end());
  if (most == t.shared.end() || *most == 0) return {};
  const float gate = options.min_shared_ratio * static_cast<float>(*most);
  std::vector<PlaceCandidate> candidates;
  for (std::uint32_t slot = 0; slot < t.shared.size(); ++slot)
    if (t.shared[slot] > 0 && static_cast<float>(t.shared[slot]) > gate)
      candidates.push_back(gather(slot, t, covisibles));

  const auto by_keyframe = [](const PlaceCandidate& a, const PlaceCandidate& b) {
    return a.keyframe != b.keyframe ? a.keyframe < b.keyframe : a.group_score > b.group_score;
  };
  std::sort(candidates.begin(), candidates.end(), by_keyframe);
  candidates.erase(
      std::unique(candidates.begin(), candidates.end(),
                  [](const auto& a, const auto& b) { return a.keyframe == b.keyframe; }),
      candidates.end());
  std::sort(candidates.begin(), candidates.end(),
            [](const PlaceCandidate& a, const PlaceCandidate& b) {
              return a.group_score != b.group_score ? a.group_score > b.group_score
                                                    : a.keyframe < b.keyframe;
            });
  return candidates;
}

}  // namespace fastloop::place
