#include <gtest/gtest.h>

#include <atomic>
#include <filesystem>
#include <thread>

#include "fastloop/map/map_file.hpp"
#include "fastloop/system/loop_closing.hpp"
#include "simulated_loop.hpp"

/// Loop closing beside its owner at the moments that hurt: while the map is saved, at shutdown, two
/// loops at once, a loop while a global adjustment runs. For ThreadSanitizer, and against deadlocks.
namespace fastloop::system {
namespace {

constexpr int kRepeats = 100;

const sim::SimulatedMap& world() {
  static const sim::SimulatedMap made = [] {
    sim::MapWorldOptions o;
    o.keyframes = 90;
    o.covisible = 10;
    o.features = 350;
    o.seed = 2;
    return sim::simulate_map(o);
  }();
  return made;
}

/// A mapper that owns the simulated map, with loop closing beside it.
struct Owner {
  std::atomic<int> applied{0}, refused{0}, ready{0};
  StageTimes times;
  mapping::Mapper mapper;
  LoopClosing loops;

  explicit Owner(bool live, bool adjust)
      : mapper(world().map.rig(), world().map.scales(), {}, {}, nullptr),
        loops(options(adjust), {}, true, live,
              {[this](const LoopRecord& r) { ++(r.correction->applied ? applied : refused); },
               [this] { ++ready; }},
              &times) {
    mapper.set_map(map::Map(world().map));
  }
  /// Makes all keyframes known but the last few, which tests hand over.
  void know() {
    map::Map known(world().map);
    loops.add_all(known);
  }
  static LoopClosingOptions options(bool adjust) {
    LoopClosingOptions o;
    o.adjust_globally = adjust;
    return o;
  }
  void wait_until_ready() {
    for (int i = 0; i < 5000 && ready == 0; ++i)
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
};

TEST(LoopThreads, ALoopIsAppliedByItsOwner) {
  Owner o(false, true);
  o.know();
  o.loops.after_keyframe(o.mapper, world().current);
  o.loops.finish(o.mapper);
  EXPECT_EQ(o.applied, 1);
  EXPECT_EQ(o.mapper.map().find_inconsistency(), std::nullopt);
  ASSERT_EQ(o.loops.records().size(), 1u);
  EXPECT_EQ(o.loops.records()[0].report.verdict, loop::Verdict::kAccepted);
}

TEST(LoopThreads, ShutdownAtAnyMoment) {
  for (int i = 0; i < kRepeats; ++i) {
    Owner o(i % 2, i % 4 >= 2);
    o.know();
    o.loops.after_keyframe(o.mapper, world().current);
    // From at once to well after the loop was found and its adjustment began.
    std::this_thread::sleep_for(std::chrono::microseconds(300 * i));
    if (i % 3) o.loops.before_keyframe(o.mapper);
  }
}

TEST(LoopThreads, TheMapIsSavedWhileALoopIsApplied) {
  const std::filesystem::path file =
      std::filesystem::temp_directory_path() / "fastloop_loop_threads.flmap";
  for (int i = 0; i < 5; ++i) {
    Owner o(false, false);
    o.know();
    const auto snapshot = o.mapper.map().publish();
    std::thread saver([&] { map::write_map_file(file, *snapshot); });
    o.loops.after_keyframe(o.mapper, world().current);
    o.loops.finish(o.mapper);
    saver.join();
    EXPECT_EQ(o.applied, 1);
    // What was saved is the map before the loop, whole.
    const map::LoadedMap saved = map::read_map_file(file);
    EXPECT_EQ(saved.map.num_landmarks(), world().map.num_landmarks());
    EXPECT_TRUE(saved.map.loop_edges().empty());
  }
  std::filesystem::remove(file);
}

TEST(LoopThreads, TwoLoopsAtOnce) {
  // The second keyframe is looked at before the owner has applied the first correction: one is
  // applied, whatever the second was computed from, and the map is sound.
  const KeyframeId earlier(world().current.value() - 2);
  for (int i = 0; i < kRepeats; ++i) {
    Owner o(i % 2, false);
    o.know();
    o.loops.after_keyframe(o.mapper, earlier);
    o.loops.after_keyframe(o.mapper, world().current);
    if (i % 2) o.wait_until_ready();
    o.loops.before_keyframe(o.mapper);
    o.loops.finish(o.mapper);
    EXPECT_GE(o.applied, 1);
    if (i % 20 == 0) EXPECT_EQ(o.mapper.map().find_inconsistency(), std::nullopt);
    EXPECT_EQ(static_cast<int>(o.mapper.map().loop_edges().size()), o.applied.load());
  }
}

TEST(LoopThreads, ALoopWhileTheAdjustmentOfTheLastOneRuns) {
  const KeyframeId earlier(world().current.value() - 2);
  for (int i = 0; i < 10; ++i) {
    Owner o(true, true);
    o.know();
    o.loops.after_keyframe(o.mapper, earlier);
    o.wait_until_ready();
    o.loops.before_keyframe(o.mapper);  // applied; the adjustment starts
    o.loops.after_keyframe(o.mapper, world().current);
    std::this_thread::sleep_for(std::chrono::milliseconds(i));
    o.loops.before_keyframe(o.mapper);
    o.loops.finish(o.mapper);
    EXPECT_GE(o.applied, 1);
    EXPECT_EQ(o.mapper.map().find_inconsistency(), std::nullopt);
  }
}

TEST(BackgroundAdjustment, CanBeCancelledAtAnyMoment) {
  const auto snapshot = world().map.publish();
  for (int i = 0; i < 20; ++i) {
    BackgroundAdjustment adjustment({}, true);
    adjustment.start(snapshot, MapId(0), false);
    std::this_thread::sleep_for(std::chrono::microseconds(500 * i));
    if (i % 2) adjustment.start(snapshot, MapId(0), false);
    adjustment.cancel();
    EXPECT_FALSE(adjustment.running());
  }
}

TEST(BackgroundAdjustment, ReducesTheErrorAndIsAppliedToAMapThatWentOn) {
  BackgroundAdjustment adjustment({}, true);
  map::Map map(world().map);
  adjustment.start(map.publish(), MapId(0), false);
  map.remove_landmark(LandmarkId(3));  // meanwhile
  const auto correction = adjustment.take();
  ASSERT_TRUE(correction.has_value());
  const auto outcome = map::apply_correction(map, *correction);
  EXPECT_TRUE(outcome.applied) << outcome.reason;
  EXPECT_EQ(map.find_inconsistency(), std::nullopt);
}

}  // namespace
}  // namespace fastloop::system
