#pragma once

#include <map>
#include <memory>
#include <shared_mutex>
#include <span>
#include <vector>

#include "fastloop/place/inverted_index.hpp"
#include "fastloop/place/vocabulary.hpp"

namespace fastloop::place {

/// Keyframes by what they look like: their words and the index over them. Any thread may ask while
/// another inserts.
class PlaceDatabase {
 public:
  using Words = std::shared_ptr<const BagOfWords>;

  /// @param vocabulary  must outlive the database
  explicit PlaceDatabase(const Vocabulary& vocabulary);

  /// Words of an image; does not touch the database.
  Words words_of(std::span<const Descriptor> descriptors,
                 const Executor& executor = Executor::cpu()) const;

  /// @throws InvalidArgument when the keyframe is there already
  void insert(KeyframeId keyframe, Words words);
  bool erase(KeyframeId keyframe);
  /// Null when the keyframe is not in the database.
  Words words(KeyframeId keyframe) const;
  std::vector<KeyframeId> keyframes() const;  ///< ascending

  /// See InvertedIndex::query.
  std::vector<PlaceCandidate> query(const BowVector& bow, std::span<const KeyframeId> excluded,
                                    const InvertedIndex::Covisibles& covisibles,
                                    const QueryOptions& options) const;

 private:
  const Vocabulary& vocabulary_;
  mutable std::shared_mutex mutex_;
  InvertedIndex index_;
  std::map<KeyframeId, Words> words_;
  std::vector<KeyframeId> ascending_;  ///< keys of words_
};

}  // namespace fastloop::place
