#pragma once

#include <memory>

#include "fastloop/map/entities.hpp"
#include "fastloop/map/map_blocks.hpp"
#include "fastloop/sensor/stereo_rig.hpp"

/// How the entities of a map lie in the blocks of a map file. Part of map_file.
namespace fastloop::map {

/// Sizes that indices in a file are checked against.
struct MapSizes {
  std::uint32_t keyframes = 0, landmarks = 0, maps = 0, loop_edges = 0, extras = 0;
};

/// Takes entries from the blocks of one name, in the order in which they were written. An entry
/// never spans two blocks.
class RecordReader {
 public:
  explicit RecordReader(BlockFileReader& file) : file_(file) {}

  /// The next entries come from blocks of this name.
  void section(const std::string& name);
  /// Call before each entry: goes on to the next block when this one is used up.
  void entry();
  /// Nothing may be left when all entries have been taken.
  void finish();

  template <Plain T>
  T get() {
    T value;
    get_bytes(&value, sizeof(value));
    return value;
  }
  bool flag();
  void get_bytes(void* data, std::size_t bytes);
  /// `count` elements; checked against what is there before memory is asked for.
  template <class T>
  void get_all(std::vector<T>& values, std::size_t count) {
    static_assert(std::is_trivially_copyable_v<T>);
    require_room(count, sizeof(T));
    values.resize(count);
    get_bytes(values.data(), count * sizeof(T));
  }
  /// There must be so many entries of at least so many bytes, or no list of them is made.
  void require_room(std::size_t count, std::size_t bytes) const {
    require(count <= bytes_.size() / bytes, "a list is longer than its block");
  }
  /// An index below `size`, or invalid when that is allowed.
  template <class SomeId>
  SomeId id(std::size_t size, bool may_be_invalid = true) {
    const SomeId value(get<std::uint32_t>());
    require(value.valid() ? value.value() < size : may_be_invalid, "an id is out of range");
    return value;
  }
  void require(bool fine, const char* what) const {
    if (!fine) file_.fail("is not consistent: " + name_ + ": " + what);
  }

 private:
  void next_block();

  BlockFileReader& file_;
  std::string name_;
  std::span<const std::byte> bytes_;  ///< not yet taken
  bool end_ = false;
};

void put(ByteWriter& w, const StereoRig& rig);
void put(ByteWriter& w, const PyramidScales& scales);
void put(ByteWriter& w, const MapInfo& info);
void put(ByteWriter& w, const LoopEdge& edge);
/// Without landmarks, features and IMU measurements, which have blocks of their own.
void put(ByteWriter& w, const Keyframe& keyframe);
void put(ByteWriter& w, const FeatureSet& features);
void put(ByteWriter& w, const PreintegratedImu& imu);
void put(ByteWriter& w, const Landmark& landmark);
void put(ByteWriter& w, const std::vector<LandmarkId>& landmarks);
void put(ByteWriter& w, const std::vector<CovisibilityEdge>& edges);

StereoRig get_rig(RecordReader& r);
PyramidScales get_scales(RecordReader& r);
MapInfo get_map_info(RecordReader& r, const MapSizes& sizes);
LoopEdge get_loop_edge(RecordReader& r, const MapSizes& sizes);

/// A keyframe and what its entry says about the other blocks.
struct KeyframeEntry {
  Keyframe keyframe;
  std::shared_ptr<KeyframeData> data;
  bool has_features = false, has_imu = false;
};
KeyframeEntry get_keyframe(RecordReader& r, const MapSizes& sizes);
std::shared_ptr<const FeatureSet> get_features(RecordReader& r, int levels);
std::shared_ptr<const PreintegratedImu> get_imu(RecordReader& r);
Landmark get_landmark(RecordReader& r, const MapSizes& sizes);
std::vector<LandmarkId> get_landmark_ids(RecordReader& r, const MapSizes& sizes);
std::vector<CovisibilityEdge> get_covisible(RecordReader& r, const MapSizes& sizes);

}  // namespace fastloop::map
