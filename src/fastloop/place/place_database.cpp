#include "fastloop/place/place_database.hpp"

#include <mutex>

namespace fastloop::place {

PlaceDatabase::PlaceDatabase(const Vocabulary& vocabulary)
    : vocabulary_(vocabulary), index_(vocabulary.num_words()) {}

PlaceDatabase::Words PlaceDatabase::words_of(std::span<const Descriptor> descriptors,
                                             const Executor& executor) const {
  Words words = std::make_shared<const BagOfWords>(vocabulary_.transform(descriptors, executor));
  words->groups.id.assign();  // nobody changes them any more
  return words;
}

void PlaceDatabase::insert(KeyframeId keyframe, Words words) {
  const std::unique_lock lock(mutex_);
  index_.insert(keyframe, words->vector);
  words_[keyframe] = std::move(words);
  ascending_.insert(std::upper_bound(ascending_.begin(), ascending_.end(), keyframe), keyframe);
}

bool PlaceDatabase::erase(KeyframeId keyframe) {
  const std::unique_lock lock(mutex_);
  if (words_.erase(keyframe) > 0)
    ascending_.erase(std::lower_bound(ascending_.begin(), ascending_.end(), keyframe));
  return index_.erase(keyframe);
}

PlaceDatabase::Words PlaceDatabase::words(KeyframeId keyframe) const {
  const std::shared_lock lock(mutex_);
  const auto it = words_.find(keyframe);
  return it == words_.end() ? nullptr : it->second;
}

std::vector<KeyframeId> PlaceDatabase::keyframes() const {
  const std::shared_lock lock(mutex_);
  return ascending_;
}

std::vector<PlaceCandidate> PlaceDatabase::query(const BowVector& bow,
                                                 std::span<const KeyframeId> excluded,
                                                 const InvertedIndex::Covisibles& covisibles,
                                                 const QueryOptions& options) const {
  const std::shared_lock lock(mutex_);
  return index_.query(bow, excluded, covisibles, options);
}

}  // namespace fastloop::place
