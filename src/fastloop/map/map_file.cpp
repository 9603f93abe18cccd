#include "fastloop/map/map_file.hpp"

#include <algorithm>

#include "fastloop/map/map_blocks.hpp"
#include "fastloop/map/map_records.hpp"

namespace fastloop::map {
namespace {

/// A block is closed when it has grown to this size.
constexpr std::size_t kBlockBytes = std::size_t{4} << 20;

/// Writes the entries of one section.
class Section {
 public:
  Section(BlockFileWriter& file, std::string name) : file_(file), name_(std::move(name)) {}
  /// put_entry(writer) writes one entry.
  void add(const auto& put_entry) {
    put_entry(bytes_);
    if (bytes_.size() >= kBlockBytes) flush();
  }
  void flush() {
    if (bytes_.size() > 0) file_.write(name_, bytes_.bytes());
    bytes_.clear();
  }

 private:
  BlockFileWriter& file_;
  std::string name_;
  ByteWriter bytes_;
};

void put_text(ByteWriter& w, const std::string& text) {
  w.put(static_cast<std::uint32_t>(text.size()));
  w.put_bytes(text.data(), text.size());
}

std::string get_text(RecordReader& r) {
  const auto size = r.get<std::uint32_t>();
  r.require_room(size, 1);
  std::string text(size, '\0');
  r.get_bytes(text.data(), size);
  return text;
}

}  // namespace

/// Reads and fills a Map's fields one to one.
class MapFileAccess {
 public:
  static LoadedMap read(const std::filesystem::path& path) {
    BlockFileReader file(path);
    try {
      RecordReader r(file);
      return read_sections(r);
    } catch (const InvalidArgument& e) {  // a constructor refused what the file says
      file.fail(std::string("is not consistent: ") + e.what());
    }
  }

 private:
  static LoadedMap read_sections(RecordReader& r) {
    r.section("map");
    r.entry();
    const auto version = r.get<std::uint64_t>(), pose_version = r.get<std::uint64_t>();
    const auto frame_version = r.get<std::uint64_t>();
    MapSizes n;
    for (std::uint32_t* size : {&n.keyframes, &n.landmarks, &n.maps, &n.loop_edges, &n.extras})
      *size = r.get<std::uint32_t>();
    const auto live_keyframes = r.get<std::uint64_t>(), live_landmarks = r.get<std::uint64_t>();
    const StereoRig rig = get_rig(r);
    const PyramidScales scales = get_scales(r);
    LoadedMap result{Map(rig, scales), {}};
    Map& map = result.map;
    map.version_ = version;
    map.pose_version_ = pose_version;
    map.frame_version_ = frame_version;
    map.num_keyframes_ = live_keyframes;
    map.num_landmarks_ = live_landmarks;
    read_maps(r, n, map);
    read_keyframes(r, n, map);
    read_landmarks(r, n, map);
    r.section("extras");
    for (std::uint32_t i = 0; i < n.extras; ++i) {
      r.entry();
      std::string name = get_text(r);
      result.extras[std::move(name)] = get_text(r);
    }
    r.require(result.extras.size() == n.extras, "a name is there twice");
    r.finish();
    check(r, map);
    return result;
  }

  static void read_maps(RecordReader& r, const MapSizes& n, Map& map) {
    r.section("maps");
    for (std::uint32_t i = 0; i < n.maps; ++i) {
      r.entry();
      map.maps_.push_back(get_map_info(r, n));
      r.require(map.maps_.back().id.value() == i, "the maps are not in order");
    }
    r.section("loops");
    for (std::uint32_t i = 0; i < n.loop_edges; ++i) {
      r.entry();
      map.loop_edges_.push_back(get_loop_edge(r, n));
    }
  }

  static void read_keyframes(RecordReader& r, const MapSizes& n, Map& map) {
    std::vector<KeyframeEntry> entries;
    r.section("keyframe");
    for (std::uint32_t i = 0; i < n.keyframes; ++i) {
      r.entry();
      entries.push_back(get_keyframe(r, n));
    }
    r.section("features");
    for (KeyframeEntry& e : entries) {
      if (!e.has_features) continue;
      r.entry();
      e.data->features = get_features(r, map.scales_.levels);
    }
    r.section("imu");
    for (KeyframeEntry& e : entries) {
      if (!e.has_imu) continue;
      r.entry();
      e.keyframe.imu_from_previous = get_imu(r);
    }
    r.section("sees");
    for (KeyframeEntry& e : entries) {
      r.entry();
      e.keyframe.landmarks = KeypointLandmarks(get_landmark_ids(r, n));
      r.require(e.keyframe.removed || e.keyframe.landmarks.size() == e.data->features->size(),
                "a keyframe has another number of keypoints");
      map.keyframes_.push_back(std::move(e.keyframe));
    }
    r.section("covisibl");
    for (std::uint32_t i = 0; i < n.keyframes; ++i) {
      r.entry();
      map.covisibility_.push_back(get_covisible(r, n));
    }
  }

  static void read_landmarks(RecordReader& r, const MapSizes& n, Map& map) {
    r.section("landmark");
    for (std::uint32_t i = 0; i < n.landmarks; ++i) {
      r.entry();
      Landmark l = get_landmark(r, n);
      const auto seen = [&](const Observation& o) {
        return o.keypoint < map.keyframe(o.keyframe).landmarks.size();
      };
      r.require(std::all_of(l.observations.begin(), l.observations.end(), seen),
                "a landmark is seen by a keypoint that does not exist");
      r.require(l.removed() || map.contains(l.anchor), "a landmark hangs on a removed keyframe");
      map.landmarks_.push_back(std::move(l));
    }
  }

  /// What reading a map relies on so as to come to an end.
  static void check(RecordReader& r, const Map& map) {
    for (std::uint32_t i = 0; i < map.keyframe_slots(); ++i) {
      const Keyframe& k = map.keyframe(KeyframeId(i));
      r.require(!k.removed || k.anchor_of_removed < KeyframeId(i),
                "a removed keyframe hangs on a newer one");
    }
    for (const MapInfo& info : map.maps()) {
      MapId id = info.id;
      for (std::size_t steps = 0; id.valid(); ++steps) {
        r.require(steps < map.maps().size(), "maps were merged in a circle");
        id = map.map_info(id).merged_into;
      }
    }
    check_replacements(r, map);
  }

  /// Chains of replaced landmarks must end; each is walked once.
  static void check_replacements(RecordReader& r, const Map& map) {
    std::vector<std::uint32_t> visited_from(map.landmark_slots(), LandmarkId::kInvalidValue);
    for (std::uint32_t i = 0; i < map.landmark_slots(); ++i) {
      LandmarkId id(i);
      while (id.valid() && map.landmark(id).removed() &&
             visited_from[id.value()] == LandmarkId::kInvalidValue) {
        visited_from[id.value()] = i;
        id = map.landmark(id).replaced_by;
        r.require(!id.valid() || visited_from[id.value()] != i,
                  "landmarks were replaced in a circle");
      }
    }
  }
};

namespace {

void write_keyframes(BlockFileWriter& file, const Snapshot& s) {
  const auto for_all = [&](const std::string& name, const auto& add) {
    Section section(file, name);
    for (std::uint32_t i = 0; i < s.keyframe_slots(); ++i)
      add(section, s.keyframe(KeyframeId(i)), KeyframeId(i));
    section.flush();
  };
  for_all("keyframe", [](Section& section, const Keyframe& k, KeyframeId) {
    section.add([&](ByteWriter& w) { put(w, k); });
  });
  for_all("features", [](Section& section, const Keyframe& k, KeyframeId) {
    if (k.data->features) section.add([&](ByteWriter& w) { put(w, *k.data->features); });
  });
  for_all("imu", [](Section& section, const Keyframe& k, KeyframeId) {
    if (k.imu_from_previous) section.add([&](ByteWriter& w) { put(w, *k.imu_from_previous); });
  });
  for_all("sees", [](Section& section, const Keyframe& k, KeyframeId) {
    section.add([&](ByteWriter& w) { put(w, k.landmarks); });
  });
  for_all("covisibl", [&](Section& section, const Keyframe&, KeyframeId id) {
    section.add([&](ByteWriter& w) { put(w, s.covisible(id)); });
  });
}

}  // namespace

void write_map_file(const std::filesystem::path& path, const Snapshot& s, const MapExtras& extras) {
  BlockFileWriter file(path);
  Section head(file, "map");
  head.add([&](ByteWriter& w) {
    w.put(s.version());
    w.put(s.pose_version());
    w.put(s.frame_version());
    for (const std::size_t size : {s.keyframe_slots(), s.landmark_slots(), s.maps().size(),
                                   s.loop_edges().size(), extras.size()})
      w.put(static_cast<std::uint32_t>(size));
    w.put<std::uint64_t>(s.num_keyframes());
    w.put<std::uint64_t>(s.num_landmarks());
    put(w, s.rig());
    put(w, s.scales());
  });
  head.flush();
  const auto write_all = [&](const std::string& name, const auto& entries, const auto& put_entry) {
    Section section(file, name);
    for (const auto& entry : entries) section.add([&](ByteWriter& w) { put_entry(w, entry); });
    section.flush();
  };
  const auto put_any = [](ByteWriter& w, const auto& entry) { put(w, entry); };
  write_all("maps", s.maps(), put_any);
  write_all("loops", s.loop_edges(), put_any);
  write_keyframes(file, s);
  Section landmarks(file, "landmark");
  for (std::uint32_t i = 0; i < s.landmark_slots(); ++i)
    landmarks.add([&](ByteWriter& w) { put(w, s.landmark(LandmarkId(i))); });
  landmarks.flush();
  write_all("extras", extras, [](ByteWriter& w, const auto& entry) {
    put_text(w, entry.first);
    put_text(w, entry.second);
  });
  file.finish();
}

LoadedMap read_map_file(const std::filesystem::path& path) {
  return MapFileAccess::read(path);
}

std::vector<MapFileSection> map_file_sections(const std::filesystem::path& path) {
  BlockFileReader file(path);
  std::vector<MapFileSection> sections;
  while (file.next()) {
    const BlockHeader& h = file.header();
    if (sections.empty() || sections.back().name != h.text())
      sections.push_back({h.text(), 0, 0, 0});
    MapFileSection& s = sections.back();
    ++s.blocks;
    s.bytes += h.bytes;
    s.file_bytes += sizeof(h) + h.packed_bytes;
  }
  return sections;
}

}  // namespace fastloop::map
