#include "fastloop/place/place_database.hpp"

#include <algorithm>
#include <mutex>

namespace fastloop::place {

PlaceDatabase::PlaceDatabase(const Vocabulary& vocabulary)
    : vocabulary_(vocabulary), index_(vocabulary.num_words()) {}

PlaceDatabase::Words PlaceDatabase::words_of(std::span<const Descriptor> descriptors) const {
  return std::make_shared<const BagOfWords>(vocabulary_.transform(descriptors));
}

void PlaceDatabase::insert(KeyframeId keyframe, Words words) {
  const std::unique_lock lock(mutex_);
  index_.insert(keyframe, words->vector);
  words_[keyframe] = std::move(words);
}

bool PlaceDatabase::erase(KeyframeId keyframe) {
  const std::unique_lock lock(mutex_);
  words_.erase(keyframe);
  return index_.erase(keyframe);
}

PlaceDatabase::Words PlaceDatabase::words(KeyframeId keyframe) const {
  const std::shared_lock lock(mutex_);
  const auto it = words_.find(keyframe);
  return it == words_.end() ? nullptr : it->second;
}

std::vector<KeyframeId> PlaceDatabase::keyframes() const {
  std::vector<KeyframeId> ids;
  const std::shared_lock lock(mutex_);
  ids.reserve(words_.size());
  for (const auto& [id, words] : words_) ids.push_back(id);
  std::sort(ids.begin(), ids.end());
  return ids;
}

std::vector<PlaceCandidate> PlaceDatabase::query(const BowVector& bow,
                                                 std::span<const KeyframeId> excluded,
                                                 const InvertedIndex::Covisibles& covisibles,
                                                 const QueryOptions& options) const {
  const std::shared_lock lock(mutex_);
  return index_.query(bow, excluded, covisibles, options);
}

}  // namespace fastloop::place
