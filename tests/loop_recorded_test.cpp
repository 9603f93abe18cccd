#include <gtest/gtest.h>

#include <filesystem>

#include "fastloop/loop/loop_replay.hpp"
#include "fastloop/map/map_file.hpp"
#include "fastloop/system/loop_closing.hpp"
#include "simulated_loop.hpp"

/// Loops recorded beside a mapper and replayed with all back ends: decisions equal to the last
/// integer, poses to 1e-6, and to what the run itself did.
namespace fastloop::system {
namespace {

namespace fs = std::filesystem;
using loop::Backend;
using loop::LoopReplay;
using loop::LoopRequest;
using loop::ReplayRun;
using loop::testing::describe;
using loop::testing::parallel_backends;
using loop::testing::small_world;

constexpr double kPoseTolerance = 1e-6;

/// Owns a simulated map, hands its last keyframe to loop closing and keeps what is recorded.
struct RecordedRun {
  fs::path folder;
  std::vector<LoopRecord> records;
  map::Map after;  ///< corrected by the run

  RecordedRun(const sim::MapWorldOptions& o, const std::string& name)
      : folder(fs::temp_directory_path() / ("fastloop_recorded_" + name)),
        after(sim::simulate_map(o).map) {
    const sim::SimulatedMap world = sim::simulate_map(o);
    fs::create_directories(folder);
    LoopClosingOptions options;
    options.adjust_globally = false;
    options.record_folder = folder;
    options.backend = Backend::kCpu;
    mapping::Mapper mapper(world.map.rig(), world.map.scales(), {}, {}, nullptr);
    mapper.set_map(map::Map(world.map));
    StageTimes times;
    LoopClosing loops(options, {}, o.inertial, false,
                      {[this](const LoopRecord& r) { records.push_back(r); }, [] {}}, &times);
    loops.add_all(mapper.map());
    loops.after_keyframe(mapper, world.current);
    loops.finish(mapper);
    after = mapper.map();
  }
  ~RecordedRun() { fs::remove_all(folder); }
};

void expect_alike(const ReplayRun& reference, const ReplayRun& other) {
  EXPECT_EQ(decision_digest(reference.outcome), decision_digest(other.outcome));
  EXPECT_LT(largest_pose_difference(reference.outcome, other.outcome), kPoseTolerance);
  EXPECT_EQ(reference.applied.applied, other.applied.applied);
  EXPECT_EQ(reference.applied.merged, other.applied.merged);
  EXPECT_EQ(reference.applied.observed, other.applied.observed);
}

class RecordedLoop : public ::testing::TestWithParam<int> {};

TEST_P(RecordedLoop, IsReplayedAlikeByAllBackEnds) {
  sim::MapWorldOptions o = small_world(40 + static_cast<std::uint64_t>(GetParam()));
  o.fisheye = GetParam() % 2;
  o.inertial = GetParam() / 2 % 2;
  o.two_maps = GetParam() >= 4;
  const RecordedRun run(o, std::to_string(GetParam()));
  ASSERT_EQ(run.records.size(), 1u);
  SCOPED_TRACE(describe(run.records[0].report));
  ASSERT_EQ(std::distance(fs::directory_iterator(run.folder), {}), 1);
  const fs::path file = fs::directory_iterator(run.folder)->path();
  const map::LoadedMap loaded = map::read_map_file(file);
  const LoopRequest request = loop::request_of(loaded, file);
  const auto snapshot = loaded.map.publish();
  const ReplayRun reference = LoopReplay(snapshot, request, Backend::kReference).run();
  EXPECT_TRUE(reference.applied.applied) << reference.applied.reason;
  for (const Backend backend : parallel_backends()) {
    SCOPED_TRACE(to_string(backend));
    const ReplayRun other = LoopReplay(snapshot, request, backend).run();
    expect_alike(reference, other);
    // The run did the same.
    ASSERT_TRUE(other.outcome.correction.has_value());
    for (const map::CorrectedState& s : other.outcome.correction->states) {
      const SE3 there = run.after.T_world_body(s.keyframe);
      EXPECT_LT((there.translation - s.after.T_world_body.translation).norm(), kPoseTolerance);
      EXPECT_LT(angle_between(there, s.after.T_world_body), kPoseTolerance);
    }
  }
}
INSTANTIATE_TEST_SUITE_P(Worlds, RecordedLoop, ::testing::Range(0, 6));

TEST(PosesOfAllBackEnds, AgreeOnLargeMaps) {
  for (const int keyframes : {300, 1000, 3000})
    for (const bool inertial : {false, true}) {
      sim::MapWorldOptions o = small_world(3);
      o.keyframes = keyframes;
      o.features = 400;
      o.inertial = inertial;
      o.loops = inertial ? 2 : 0;
      const sim::SimulatedMap world = sim::simulate_map(o);
      LoopRequest request;
      request.keyframe = world.current;
      request.inertial = inertial;
      const auto snapshot = world.map.publish();
      const ReplayRun reference = LoopReplay(snapshot, request, Backend::kReference).run();
      ASSERT_TRUE(reference.outcome.correction.has_value()) << describe(reference.outcome.report);
      EXPECT_TRUE(reference.applied.applied) << reference.applied.reason;
      for (const Backend backend : parallel_backends()) {
        const ReplayRun other = LoopReplay(snapshot, request, backend).run();
        SCOPED_TRACE(std::string(to_string(backend)) + "\n" + describe(other.outcome.report));
        expect_alike(reference, other);
      }
    }
}

TEST(AllBackEnds, DecideAlikeInTwoHundredWorlds) {
  int accepted = 0, refused = 0;
  for (unsigned seed = 100; seed < 300; ++seed) {
    sim::MapWorldOptions o = small_world(seed);
    o.keyframes = 90;
    o.covisible = 10;
    o.features = seed % 6 == 1 ? 170 : 450;  // too few to confirm
    o.fisheye = seed % 2;
    o.inertial = seed % 4 >= 2;
    o.two_maps = seed % 5 == 0;
    o.noise_px = seed % 9 == 4 ? 4 : 0.5;
    o.drift_scale = seed % 11 == 3 ? 10 : 1;
    const sim::SimulatedMap world = sim::simulate_map(o);
    LoopRequest request;
    request.keyframe = world.current;
    request.inertial = o.inertial;
    const auto snapshot = world.map.publish();
    const ReplayRun reference = LoopReplay(snapshot, request, Backend::kReference).run();
    for (const Backend backend : parallel_backends()) {
      const ReplayRun other = LoopReplay(snapshot, request, backend).run();
      SCOPED_TRACE(::testing::Message() << "seed " << seed << ", " << to_string(backend) << "\n"
                                        << describe(other.outcome.report));
      expect_alike(reference, other);
      ASSERT_FALSE(HasFailure());
    }
    ++(reference.outcome.correction ? accepted : refused);
  }
  EXPECT_GT(accepted, 100);
  EXPECT_GT(refused, 20);
}

}  // namespace
}  // namespace fastloop::system
