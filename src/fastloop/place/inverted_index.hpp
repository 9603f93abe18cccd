#pragma once

#include <functional>
#include <span>
#include <unordered_map>
#include <vector>

#include "fastloop/core/ids.hpp"
#include "fastloop/matching/bag_of_words.hpp"

namespace fastloop::place {

struct QueryOptions {
  float min_shared_ratio =
      0.8f;  ///< keep keyframes sharing more than this part of the most shared words
};

/// A group of covisible keyframes that look like the query.
struct PlaceCandidate {
  KeyframeId keyframe;    ///< the group's most similar member
  float score = 0;        ///< its L1 score
  float group_score = 0;  ///< sum over the group
  int shared_words = 0;   ///< of `keyframe` with the query
  bool operator==(const PlaceCandidate&) const = default;
};

/// For each word the keyframes that contain it. Queries are reentrant; insert and erase are not.
///
/// The lists of all words lie in one array (CSR with spare room): a list that outgrows its room
/// moves to the end, and the array is packed anew when half of it is unused.
class InvertedIndex {
 public:
  explicit InvertedIndex(std::size_t num_words);

  /// @throws InvalidArgument when the keyframe is there already or a word is out of range
  void insert(KeyframeId keyframe, const BowVector& bow);
  /// Forgets a keyframe; false when it is unknown.
  bool erase(KeyframeId keyframe);
  bool contains(KeyframeId keyframe) const { return slot_.contains(keyframe); }
  std::size_t size() const { return slot_.size(); }

  /// The best covisible keyframes of one (ten in the published method), in any order.
  using Covisibles = std::function<std::vector<KeyframeId>(KeyframeId)>;

  /// Keyframes that look like `bow`:
  /// 1. count the words shared with every keyframe that is not excluded;
  /// 2. keep those with more than min_shared_ratio of the largest count;
  /// 3. each of them gathers its covisibles that share at least one word: the group's score is the
  /// sum of
  ///    their L1 scores, and its best member stands for it (ties: the lower id);
  /// 4. one candidate per best member, with the largest group score it was given.
  ///
  /// @param excluded  usually the query and what is connected to it; takes no part at all
  /// @return descending group score; ties: ascending id. The caller takes the first few of each
  /// map.
  std::vector<PlaceCandidate> query(const BowVector& bow, std::span<const KeyframeId> excluded,
                                    const Covisibles& covisibles,
                                    const QueryOptions& options = {}) const;

 private:
  struct Posting {
    std::uint32_t slot;
    float weight;
  };
  struct List {
    std::uint32_t begin = 0, size = 0, room = 0;
  };
  struct Entry {
    KeyframeId keyframe;  ///< invalid: slot is free
    std::vector<std::uint32_t> words;
  };
  /// Shared words and score of every slot.
  struct Tally {
    std::vector<std::int32_t> shared;
    std::vector<float> score;
  };

  void ask_ahead(const BowVector& bow, std::size_t i) const;
  void append(std::uint32_t word, Posting posting);
  void pack();
  Tally tally(const BowVector& bow, std::span<const KeyframeId> excluded) const;
  PlaceCandidate gather(std::uint32_t slot, const Tally& tally, const Covisibles& covisibles) const;

  std::vector<List> lists_;  ///< [words]
  std::vector<Posting> pool_;
  std::size_t unused_ = 0;      ///< room in `pool_` that no list owns
  std::vector<Entry> entries_;  ///< [slots]
  std::vector<std::uint32_t> free_slots_;
  std::unordered_map<KeyframeId, std::uint32_t> slot_;
};

}  // namespace fastloop::place
