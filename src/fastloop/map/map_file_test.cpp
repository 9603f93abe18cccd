#include "fastloop/map/map_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/resource.h>
#include <unistd.h>
#include <zstd.h>

#include <csignal>
#include <cstring>
#include <fstream>
#include <set>

#include "fastloop/core/checksum.hpp"
#include "fastloop/map/map_blocks.hpp"
#include "fastloop/map/synthetic_map_for_tests.hpp"

namespace fastloop::map {
namespace {

namespace fs = std::filesystem;
using testing::pose_at;
using testing::SyntheticMap;
using testing::SyntheticWorld;
using testing::ViewOptions;

class MapFile : public ::testing::Test {
 protected:
  void SetUp() override {
    folder_ = fs::path(::testing::TempDir()) / ("map_file_" + std::to_string(::getpid()));
    fs::create_directories(folder_);
    file_ = folder_ / "a.flmap";
  }
  void TearDown() override { fs::remove_all(folder_); }

  fs::path folder_, file_;
};

std::string bytes_of(const fs::path& file) {
  std::ifstream in(file, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

void write_bytes(const fs::path& file, const std::string& bytes) {
  std::ofstream(file, std::ios::binary) << bytes;
}

void put_byte(const fs::path& file, std::size_t at, char value) {
  std::fstream f(file, std::ios::binary | std::ios::in | std::ios::out);
  f.seekp(static_cast<std::streamoff>(at));
  f.put(value);
}

std::shared_ptr<const PreintegratedImu> imu_between(const Map& m, KeyframeId a, KeyframeId b,
                                                    std::mt19937& rng) {
  std::vector<ImuSample> samples;
  const Nanoseconds begin = m.keyframe(a).data->stamp_ns, end = m.keyframe(b).data->stamp_ns;
  for (Nanoseconds t = begin - 3'000'000; t < end + 5'000'000; t += 5'000'000)
    samples.push_back({t, testing::normal_vector(rng, 0.1), testing::normal_vector(rng, 1)});
  ImuCalibration noise;
  noise.rate_hz = 199;
  return std::make_shared<PreintegratedImu>(samples, begin, end, m.keyframe(a).state.bias, noise);
}

/// Everything that a map can hold: two maps of which one was merged, removed keyframes, merged and
/// removed landmarks, IMU with joined intervals, states with velocity and bias, loop edges.
Map eventful_map(unsigned seed, int points = 150) {
  std::mt19937 rng(seed);
  const SyntheticWorld world(points, {6, 6, 3}, seed);
  SyntheticMap s(world);
  ViewOptions view;
  view.clutter = 5;
  view.stereo_share = 0.7;
  for (int i = 0; i < 12; ++i) {
    if (i == 6) {
      s.id = s.map.start_map();
      std::fill(s.landmark_of.begin(), s.landmark_of.end(), LandmarkId{});
    }
    const KeyframeId k = s.add(pose_at({0.2 * i, 0.1, 0}, 0.05 * i), view, rng);
    NavState state = s.map.keyframe(k).state;
    state.v_world = testing::normal_vector(rng, 1);
    state.bias = {testing::normal_vector(rng, 0.01), testing::normal_vector(rng, 0.1)};
    s.map.set_state(k, state);
    if (i % 6) s.map.set_imu(k, imu_between(s.map, KeyframeId(k.value() - 1), k, rng));
  }
  Map& m = s.map;
  m.remove_keyframe(KeyframeId(3));
  m.remove_keyframe(KeyframeId(4));
  m.merge_maps(MapId(1), MapId(0), KeyframeId(7));
  m.remove_landmark(LandmarkId(1));
  const auto& seen = m.keyframe(KeyframeId(7)).landmarks;
  const auto any = std::find_if(seen.begin(), seen.end(), [](LandmarkId l) { return l.valid(); });
  m.replace_landmark(*any, LandmarkId(0));
  m.add_loop_edge({KeyframeId(0), KeyframeId(9), SE3(so3::exp({0.1, 0.2, 0.3}), {1, 2, 3})});
  m.add_loop_edge({KeyframeId(3), KeyframeId(11), SE3()});
  m.mutable_info(MapId(0)).imu_initialized = true;
  m.mutable_info(MapId(0)).imu_refinements = 2;
  return m;
}

template <class T>
bool same_bits(const std::vector<T>& a, const std::vector<T>& b) {
  return a.size() == b.size() &&
         (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0);
}

bool same_bits(const SE3& a, const SE3& b) {
  return a.rotation.coeffs() == b.rotation.coeffs() && a.translation == b.translation;
}

void expect_same(const FeatureSet& a, const FeatureSet& b) {
  EXPECT_TRUE(same_bits(a.x, b.x) && same_bits(a.y, b.y) && same_bits(a.angle_rad, b.angle_rad) &&
              same_bits(a.octave, b.octave) && same_bits(a.descriptors, b.descriptors) &&
              same_bits(a.right_x, b.right_x) && same_bits(a.right_y, b.right_y) &&
              same_bits(a.depth_m, b.depth_m));
  EXPECT_EQ(a.grid.start, b.grid.start);
  EXPECT_EQ(a.grid.indices, b.grid.indices);
  EXPECT_EQ(a.grid.cell_width_px, b.grid.cell_width_px);
  EXPECT_EQ(a.grid.cell_height_px, b.grid.cell_height_px);
  EXPECT_EQ(a.image_width, b.image_width);
  EXPECT_EQ(a.image_height, b.image_height);
}

void expect_same(const PreintegratedImu& a, const PreintegratedImu& b) {
  EXPECT_EQ(a.begin_ns(), b.begin_ns());
  EXPECT_EQ(a.end_ns(), b.end_ns());
  ASSERT_EQ(a.samples().size(), b.samples().size());
  for (std::size_t i = 0; i < a.samples().size(); ++i) {
    EXPECT_EQ(a.samples()[i].stamp_ns, b.samples()[i].stamp_ns);
    EXPECT_EQ(a.samples()[i].gyro, b.samples()[i].gyro);
    EXPECT_EQ(a.samples()[i].accel, b.samples()[i].accel);
  }
  EXPECT_EQ(a.bias().gyro, b.bias().gyro);
  EXPECT_EQ(a.noise().rate_hz, b.noise().rate_hz);
  EXPECT_EQ(a.covariance(), b.covariance());
  EXPECT_EQ(a.delta_rotation(a.bias()).coeffs(), b.delta_rotation(a.bias()).coeffs());
  EXPECT_EQ(a.delta_velocity(a.bias()), b.delta_velocity(a.bias()));
  EXPECT_EQ(a.delta_position(a.bias()), b.delta_position(a.bias()));
  EXPECT_EQ(a.d_position_d_accel_bias(), b.d_position_d_accel_bias());
}

void expect_same(const Keyframe& a, const Keyframe& b) {
  EXPECT_EQ(a.data->frame, b.data->frame);
  EXPECT_EQ(a.data->stamp_ns, b.data->stamp_ns);
  EXPECT_EQ(a.map, b.map);
  EXPECT_TRUE(same_bits(a.state.T_world_body, b.state.T_world_body));
  EXPECT_EQ(a.state.v_world, b.state.v_world);
  EXPECT_EQ(a.state.bias.gyro, b.state.bias.gyro);
  EXPECT_EQ(a.state.bias.accel, b.state.bias.accel);
  EXPECT_EQ(a.landmarks, b.landmarks);
  EXPECT_EQ(a.parent, b.parent);
  EXPECT_EQ(a.previous, b.previous);
  EXPECT_EQ(a.next, b.next);
  EXPECT_EQ(a.removed, b.removed);
  EXPECT_EQ(a.anchor_of_removed, b.anchor_of_removed);
  EXPECT_TRUE(same_bits(a.T_anchor_body, b.T_anchor_body));
  ASSERT_EQ(a.data->features != nullptr, b.data->features != nullptr);
  if (a.data->features) expect_same(*a.data->features, *b.data->features);
  ASSERT_EQ(a.imu_from_previous != nullptr, b.imu_from_previous != nullptr);
  if (a.imu_from_previous) expect_same(*a.imu_from_previous, *b.imu_from_previous);
}

void expect_same(const Landmark& a, const Landmark& b) {
  EXPECT_EQ(a.anchor, b.anchor);
  EXPECT_EQ(a.replaced_by, b.replaced_by);
  EXPECT_EQ(a.p_anchor, b.p_anchor);
  EXPECT_EQ(a.normal_anchor, b.normal_anchor);
  EXPECT_EQ(a.min_distance_m, b.min_distance_m);
  EXPECT_EQ(a.max_distance_m, b.max_distance_m);
  EXPECT_EQ(a.descriptor, b.descriptor);
  EXPECT_TRUE(same_bits(a.observations, b.observations));
  EXPECT_EQ(a.first_keyframe, b.first_keyframe);
  EXPECT_EQ(a.visible, b.visible);
  EXPECT_EQ(a.found, b.found);
}

void expect_same(const MapInfo& a, const MapInfo& b) {
  EXPECT_EQ(a.id, b.id);
  EXPECT_EQ(a.first_keyframe, b.first_keyframe);
  EXPECT_EQ(a.last_keyframe, b.last_keyframe);
  EXPECT_EQ(a.imu_initialized, b.imu_initialized);
  EXPECT_EQ(a.imu_refinements, b.imu_refinements);
  EXPECT_EQ(a.num_keyframes, b.num_keyframes);
  EXPECT_EQ(a.merged_into, b.merged_into);
}

void expect_same(const Snapshot& a, const Snapshot& b) {
  EXPECT_EQ(a.version(), b.version());
  EXPECT_EQ(a.pose_version(), b.pose_version());
  EXPECT_EQ(a.frame_version(), b.frame_version());
  EXPECT_EQ(a.num_keyframes(), b.num_keyframes());
  EXPECT_EQ(a.num_landmarks(), b.num_landmarks());
  EXPECT_EQ(std::memcmp(&a.rig(), &b.rig(), sizeof(int)), 0);
  EXPECT_EQ(a.rig().left.fx, b.rig().left.fx);
  EXPECT_EQ(a.rig().right.distortion, b.rig().right.distortion);
  EXPECT_TRUE(same_bits(a.rig().T_body_left, b.rig().T_body_left));
  EXPECT_TRUE(same_bits(a.rig().T_right_left, b.rig().T_right_left));
  EXPECT_EQ(a.rig().baseline_m, b.rig().baseline_m);
  EXPECT_EQ(a.scales().sigma2, b.scales().sigma2);
  EXPECT_EQ(a.scales().scale, b.scales().scale);
  ASSERT_EQ(a.keyframe_slots(), b.keyframe_slots());
  for (std::uint32_t i = 0; i < a.keyframe_slots(); ++i) {
    expect_same(a.keyframe(KeyframeId(i)), b.keyframe(KeyframeId(i)));
    EXPECT_TRUE(same_bits(a.covisible(KeyframeId(i)), b.covisible(KeyframeId(i))));
  }
  ASSERT_EQ(a.landmark_slots(), b.landmark_slots());
  for (std::uint32_t i = 0; i < a.landmark_slots(); ++i)
    expect_same(a.landmark(LandmarkId(i)), b.landmark(LandmarkId(i)));
  ASSERT_EQ(a.maps().size(), b.maps().size());
  for (std::size_t i = 0; i < a.maps().size(); ++i) expect_same(a.maps()[i], b.maps()[i]);
  ASSERT_EQ(a.loop_edges().size(), b.loop_edges().size());
  for (std::size_t i = 0; i < a.loop_edges().size(); ++i) {
    EXPECT_EQ(a.loop_edges()[i].a, b.loop_edges()[i].a);
    EXPECT_EQ(a.loop_edges()[i].b, b.loop_edges()[i].b);
    EXPECT_TRUE(same_bits(a.loop_edges()[i].T_a_b, b.loop_edges()[i].T_a_b));
  }
}

/// What reading the file says; empty when it can be read.
std::string complaint(const fs::path& file) {
  try {
    read_map_file(file);
    return "";
  } catch (const InputError& e) {
    EXPECT_EQ(e.where().file, file.string());
    return e.what();
  }
}

TEST_F(MapFile, ExactRoundTripOfEverything) {
  const MapExtras extras{
      {"truth", "{\"a\": 1}"}, {"empty", ""}, {"bytes", std::string("\0\xff", 2)}};
  for (unsigned seed = 1; seed <= 5; ++seed) {
    const Map map = eventful_map(seed);
    ASSERT_GT(map.keyframe_slots(), map.num_keyframes());
    ASSERT_GT(map.landmark_slots(), map.num_landmarks() + 1);
    write_map_file(file_, map, extras);
    const LoadedMap loaded = read_map_file(file_);
    expect_same(map, loaded.map);
    EXPECT_EQ(loaded.extras, extras);
    EXPECT_EQ(loaded.map.find_inconsistency().value_or(""), "");
    const fs::path again = folder_ / "b.flmap";
    write_map_file(again, loaded.map, loaded.extras);
    EXPECT_EQ(bytes_of(file_), bytes_of(again));
  }
}

TEST_F(MapFile, LoadedMapGoesOnGrowing) {
  const Map map = eventful_map(1);
  write_map_file(file_, map);
  Map loaded = read_map_file(file_).map;
  const KeyframeId id =
      loaded.add_keyframe(MapId(0), map.keyframe(KeyframeId(0)).data, {}, nullptr);
  loaded.add_landmark(id, 0, {1, 2, 3});
  loaded.attach_to_spanning_tree(id);
  loaded.remove_keyframe(KeyframeId(8));
  EXPECT_EQ(loaded.find_inconsistency().value_or(""), "");
}

TEST_F(MapFile, EmptyMap) {
  const SyntheticWorld world(1, {1, 1, 1}, 1);
  const Map map(world.rig, world.scales);
  write_map_file(file_, map);
  expect_same(map, read_map_file(file_).map);
}

TEST_F(MapFile, ManyBlocksOfOneSection) {
  std::mt19937 rng(1);
  const SyntheticWorld world(2000, {6, 6, 3}, 1);
  SyntheticMap s(world);
  for (int i = 0; i < 150; ++i) s.add(pose_at({0.01 * i, 0, 0}, 0), {.clutter = 500}, rng, 0.1);
  write_map_file(file_, s.map);
  expect_same(s.map, read_map_file(file_).map);
  bool several = false;
  for (const MapFileSection& section : map_file_sections(file_)) several |= section.blocks > 1;
  EXPECT_TRUE(several);
}

TEST_F(MapFile, EveryFlippedByteIsSeen) {
  write_map_file(file_, eventful_map(2, 30), {{"x", "y"}});
  const std::string good = bytes_of(file_);
  const fs::path bad = folder_ / "bad.flmap";
  write_bytes(bad, good);
  // Every byte of the beginning, where the headers are, then every seventh.
  for (std::size_t i = 0; i < good.size(); i += i < 600 ? 1 : 7) {
    put_byte(bad, i, static_cast<char>(good[i] ^ (1 << (i % 8))));
    EXPECT_NE(complaint(bad), "") << "byte " << i;
    put_byte(bad, i, good[i]);
  }
  EXPECT_EQ(complaint(bad), "");
}

TEST_F(MapFile, EveryTruncationIsSeen) {
  write_map_file(file_, eventful_map(2, 30), {{"x", "y"}});
  const std::string good = bytes_of(file_);
  const fs::path bad = folder_ / "bad.flmap";
  write_bytes(bad, good);
  // Every length near both ends, every third between.
  for (std::size_t size = good.size() - 1; size > 0;
       size -= size > 1000 && size + 1000 < good.size() ? 3 : 1) {
    fs::resize_file(bad, size);
    EXPECT_NE(complaint(bad), "") << size << " bytes";
  }
  write_bytes(bad, good + "x");
  EXPECT_THAT(complaint(bad), ::testing::HasSubstr("after its end"));
}

TEST_F(MapFile, OtherFilesAreRefusedWithTheReason) {
  EXPECT_THAT(complaint(folder_ / "missing"), ::testing::HasSubstr("cannot be opened"));
  EXPECT_THAT(complaint(folder_), ::testing::HasSubstr("folder"));
  write_bytes(file_, "");
  EXPECT_THAT(complaint(file_), ::testing::HasSubstr("too short"));
  write_bytes(file_, std::string(1000, 'x'));
  EXPECT_THAT(complaint(file_), ::testing::HasSubstr("not a map"));
  write_map_file(file_, eventful_map(1, 30));
  std::string bytes = bytes_of(file_);
  bytes[8] = 2;
  write_bytes(file_, bytes);
  EXPECT_THAT(complaint(file_), ::testing::HasSubstr("newer than this program"));
}

/// The blocks of a file, unpacked, to be forged and sealed again with right checksums.
std::string forged(const std::string& bytes, const std::string& section, std::size_t offset,
                   std::uint32_t value) {
  std::string out = bytes.substr(0, 16);
  for (std::size_t at = 16; at < bytes.size();) {
    BlockHeader h;
    std::memcpy(static_cast<void*>(&h), bytes.data() + at, sizeof(h));
    std::string raw(h.bytes, '\0');
    ZSTD_decompress(raw.data(), raw.size(), bytes.data() + at + sizeof(h), h.packed_bytes);
    at += sizeof(h) + h.packed_bytes;
    if (h.text() == section) std::memcpy(raw.data() + offset, &value, sizeof(value));
    std::string packed(ZSTD_compressBound(raw.size()), '\0');
    packed.resize(ZSTD_compress(packed.data(), packed.size(), raw.data(), raw.size(), 1));
    h.packed_bytes = packed.size();
    h.checksum = 0;
    h.checksum = crc64(std::as_bytes(std::span(packed)), crc64(std::as_bytes(std::span(&h, 1))));
    out += std::string(reinterpret_cast<const char*>(&h), sizeof(h)) + packed;
  }
  return out;
}

TEST_F(MapFile, ForgedNumbersWithRightChecksumsNeitherCrashNorAskForMuchMemory) {
  write_map_file(file_, eventful_map(2, 30), {{"x", "y"}});
  const std::string good = bytes_of(file_);
  const fs::path bad = folder_ / "bad.flmap";
  EXPECT_EQ(forged(good, "none", 0, 0), good);
  struct rusage before, after;
  ASSERT_EQ(::getrusage(RUSAGE_SELF, &before), 0);
  int refused = 0;
  for (const char* section : {"map", "maps", "keyframe", "features", "imu", "sees", "covisibl",
                              "landmark", "loops", "extras"})
    for (std::size_t offset = 0; offset < 120; offset += 4)
      for (const std::uint32_t value : {0u, 7u, 0x7fffffffu, 0xfffffff0u, 0xffffffffu}) {
        std::size_t size = 0;
        for (const MapFileSection& s : map_file_sections(file_))
          if (s.name == section) size = s.bytes;
        if (offset + 4 > size) continue;
        write_bytes(bad, forged(good, section, offset, value));
        try {
          const LoadedMap loaded = read_map_file(bad);
          // Whatever was let through can be walked over.
          loaded.map.find_inconsistency();
          for (std::uint32_t l = 0; l < loaded.map.landmark_slots(); ++l)
            loaded.map.resolve(LandmarkId(l));
        } catch (const InputError&) {
          ++refused;
        }
      }
  EXPECT_GT(refused, 100);
  ASSERT_EQ(::getrusage(RUSAGE_SELF, &after), 0);
  EXPECT_LT(after.ru_maxrss - before.ru_maxrss, 1 << 20) << "KiB";
}

TEST_F(MapFile, FailedWriteLeavesTheOldFileAndNoRest) {
  write_map_file(file_, eventful_map(1, 30));
  const std::string before = bytes_of(file_);
  // A limit on the size of files is what a full disk looks like to the program.
  struct rlimit limit, tight;
  ASSERT_EQ(::getrlimit(RLIMIT_FSIZE, &limit), 0);
  tight = limit;
  tight.rlim_cur = 1000;
  const auto handler = std::signal(SIGXFSZ, SIG_IGN);
  ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &tight), 0);
  std::string message;
  try {
    write_map_file(file_, eventful_map(3));
  } catch (const InputError& e) {
    message = e.what();
  }
  ::setrlimit(RLIMIT_FSIZE, &limit);
  std::signal(SIGXFSZ, handler);
  EXPECT_THAT(message, ::testing::HasSubstr("cannot be written"));
  EXPECT_THAT(message, ::testing::HasSubstr(file_.string()));
  EXPECT_EQ(bytes_of(file_), before);
  EXPECT_EQ(std::distance(fs::directory_iterator(folder_), fs::directory_iterator()), 1);
  EXPECT_THROW(write_map_file(folder_ / "no" / "a", eventful_map(1, 30)), InputError);
}

TEST_F(MapFile, SectionsAddUpToTheFile) {
  write_map_file(file_, eventful_map(1), {{"x", "y"}});
  std::uint64_t sum = 16 + sizeof(BlockHeader) + ZSTD_compressBound(0);
  std::set<std::string> names;
  for (const MapFileSection& s : map_file_sections(file_)) {
    sum += s.file_bytes;
    names.insert(s.name);
  }
  EXPECT_NEAR(static_cast<double>(sum), static_cast<double>(fs::file_size(file_)), 64);
  EXPECT_TRUE(names.contains("features") && names.contains("imu") && names.contains("extras"));
}

}  // namespace
}  // namespace fastloop::map
