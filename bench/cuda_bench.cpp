// The searches of matching/ on one NVIDIA GPU against the published sequential way on one host core
// and against all host cores, on simulated maps. Medians of alternating runs; times on the device
// include packing, all transfers and unpacking. Checks that all find the same.
//   cuda_bench [--repeat N] [--quick]
#include <algorithm>
#include <cstdio>
#include <cstring>
#include <functional>
#include <set>

#include "fastloop/compute/cuda_session.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/map/landmark_arrays.hpp"
#include "fastloop/matching/descriptor_matching.hpp"
#include "fastloop/matching/resident_store.hpp"
#include "fastloop/sim/map_worlds.hpp"

namespace fastloop {
namespace {

using namespace matching;

struct Times {
  std::vector<double> ms;
  double at(double q) {
    std::sort(ms.begin(), ms.end());
    return ms[std::min(ms.size() - 1, static_cast<std::size_t>(q * static_cast<double>(ms.size())))];
  }
  double median() { return at(0.5); }
};

/// Runs the bodies in turn, `repeat` times after one round that is not counted; slow ones less often.
std::vector<Times> alternate(int repeat, const std::vector<std::function<void()>>& bodies) {
  std::vector<Times> times(bodies.size());
  for (int i = -1; i < repeat; ++i)
    for (std::size_t b = 0; b < bodies.size(); ++b) {
      if (i > 10 && times[b].ms.back() > 20) continue;
      const Stopwatch watch;
      bodies[b]();
      const double ms = watch.elapsed_ms();
      if (i >= 0) times[b].ms.push_back(ms);
    }
  return times;
}

/// A loop about to be fused: keyframes at the end of the way, put where they belong, and landmarks
/// of the keyframes that were there first.
struct Place {
  sim::SimulatedMap simulated;
  std::vector<SearchTarget> targets;
  map::LandmarkArrays cloud;
};

Place make_place(const sim::MapWorldOptions& options, std::size_t landmarks, std::size_t targets) {
  Place p{sim::simulate_map(options), {}, {}};
  const auto snapshot = p.simulated.map.publish();
  const KeyframeId matched = p.simulated.expected_matches.front();
  const SE3 T_map_truth =
      snapshot->T_world_body(matched) * p.simulated.truth[matched.value()].inverse();
  for (std::size_t i = 0; i < targets; ++i) {
    const KeyframeId id(p.simulated.current.value() - static_cast<std::uint32_t>(i));
    SearchTarget t;
    t.features = snapshot->keyframe(id).data->features.get();
    t.T_camera_world =
        (T_map_truth * p.simulated.truth[id.value()] * snapshot->rig().T_body_left).inverse();
    p.targets.push_back(t);
  }
  // The nearest keyframes of the first visit until there are landmarks enough.
  std::set<LandmarkId> chosen;
  for (std::uint32_t step = 0; chosen.size() < landmarks && step < 400; ++step) {
    const std::uint32_t k = step % 2 ? matched.value() + (step + 1) / 2
                                     : matched.value() - std::min(matched.value(), step / 2);
    if (k >= snapshot->keyframe_slots() || !snapshot->contains(KeyframeId(k))) continue;
    for (const LandmarkId id : snapshot->keyframe(KeyframeId(k)).landmarks)
      if (id.valid() && chosen.size() < landmarks) chosen.insert(id);
  }
  p.cloud = map::LandmarkArrays(*snapshot, {chosen.begin(), chosen.end()});
  return p;
}

bool equal(const ProjectionMatches& a, const ProjectionMatches& b) {
  return a.keypoint == b.keypoint && a.distance == b.distance && a.in_view == b.in_view;
}

void projection(const std::shared_ptr<CudaSession>& session, const char* name, int repeat,
                bool fisheye, std::size_t landmarks, std::size_t num_targets, float radius_px,
                int max_distance) {
  sim::MapWorldOptions world;
  world.keyframes = 400;
  world.features = 1200;
  world.fisheye = fisheye;
  const Place place = make_place(world, landmarks, num_targets);
  const auto snapshot = place.simulated.map.publish();
  const Executor device = Executor::cuda(session);
  std::vector<std::shared_ptr<const FeatureSet>> alive;
  for (std::size_t k = 0; k < snapshot->keyframe_slots(); ++k)
    make_resident(device, snapshot->keyframe(KeyframeId(static_cast<std::uint32_t>(k))).data->features);
  LandmarkView view = place.cloud.view();
  ProjectionSearchOptions rule;
  rule.radius_px = radius_px;
  rule.max_distance = max_distance;
  std::vector<std::vector<ProjectionMatches>> found(3);
  for (auto& f : found) f.resize(num_targets);
  const auto dense = [&](const Executor& e, std::size_t slot) {
    search_by_projection(e, snapshot->rig(), snapshot->scales(), place.targets, view, rule,
                         found[slot]);
  };
  std::vector<MatchLists> lists(3);
  const auto compact = [&](const Executor& e, const LandmarkView& l, std::size_t slot) {
    const ProjectionJob job{l, place.targets};
    lists[slot] = find_by_projection(e, snapshot->rig(), snapshot->scales(), {&job, 1}, rule);
  };
  const auto resident = make_resident(device, view);
  LandmarkView on_device = view;
  on_device.resident = resident.get();
  auto t = alternate(repeat, {[&] { dense(Executor::reference(), 0); },
                              [&] { dense(Executor::cpu(), 1); },
                              [&] { dense(device, 2); },
                              [&] { compact(Executor::cpu(), view, 0); },
                              [&] { compact(device, view, 1); },
                              [&] { compact(device, on_device, 2); }});
  bool same = lists[0].matches == lists[1].matches && lists[0].matches == lists[2].matches;
  std::size_t seen = 0, matches = 0;
  for (std::size_t i = 0; i < num_targets; ++i) {
    same = same && equal(found[0][i], found[1][i]) && equal(found[0][i], found[2][i]);
    for (const std::uint8_t s : found[0][i].in_view) seen += s;
    matches += static_cast<std::size_t>(found[0][i].count);
  }
  const double reference = t[0].median();
  std::printf("%-20s %6zu x %2zu  in view %4.1f %%  matches %6zu  %s\n", name, view.size(),
              num_targets, 100.0 * static_cast<double>(seen) / static_cast<double>(view.size() * num_targets),
              matches, same ? "same" : "DIFFERENT");
  const char* label[] = {"reference", "cpu", "cuda", "cpu, compact", "cuda, compact",
                         "cuda, compact, landmarks resident"};
  for (std::size_t i = 0; i < t.size(); ++i)
    std::printf("   %-34s median %9.4f ms  p10 %9.4f  p90 %9.4f  ratio %7.1f\n", label[i],
                t[i].median(), t[i].at(0.1), t[i].at(0.9), reference / t[i].median());
  std::fflush(stdout);
}

/// Groups as a vocabulary of 128 nodes would make them.
FeatureGroups groups_of(const FeatureSet& f) {
  FeatureGroups g;
  g.start.push_back(0);
  for (std::uint32_t node = 0; node < 128; ++node) {
    for (std::size_t i = 0; i < f.size(); ++i)
      if ((f.descriptors[i].words[0] & 127u) == node)
        g.indices.push_back(static_cast<std::uint16_t>(i));
    if (g.indices.size() == g.start.back()) continue;
    g.node.push_back(node);
    g.start.push_back(static_cast<std::uint32_t>(g.indices.size()));
  }
  return g;
}

void bag_of_words(const std::shared_ptr<CudaSession>& session, int repeat, std::uint32_t images) {
  sim::MapWorldOptions world;
  world.keyframes = 400;
  world.features = 1200;
  const sim::SimulatedMap simulated = sim::simulate_map(world);
  const auto snapshot = simulated.map.publish();
  const Executor device = Executor::cuda(session);
  const auto features = [&](std::uint32_t k) { return snapshot->keyframe(KeyframeId(k)).data->features; };
  const auto mask = [&](std::uint32_t k) {
    std::vector<std::uint8_t> m;
    for (const LandmarkId id : snapshot->keyframe(KeyframeId(k)).landmarks) m.push_back(!id.valid());
    return m;
  };
  const std::uint32_t current = simulated.current.value();
  const FeatureGroups own = groups_of(*features(current));
  const auto own_mask = mask(current);
  make_resident(device, features(current));
  std::vector<FeatureGroups> groups;
  std::vector<std::vector<std::uint8_t>> masks;
  for (std::uint32_t k = 0; k < images; ++k) {
    groups.push_back(groups_of(*features(k)));
    masks.push_back(mask(k));
    make_resident(device, features(k));
  }
  std::vector<MatchSide> seconds;
  for (std::uint32_t k = 0; k < images; ++k) seconds.push_back({features(k).get(), &groups[k], masks[k]});
  const MatchSide first{features(current).get(), &own, own_mask};
  std::vector<std::vector<std::int32_t>> found[3];
  auto t = alternate(repeat, {[&] { found[0] = match_descriptors(Executor::reference(), first, seconds); },
                              [&] { found[1] = match_descriptors(Executor::cpu(), first, seconds); },
                              [&] { found[2] = match_descriptors(device, first, seconds); }});
  std::printf("bag of words, %u pairs  %s\n", images,
              found[0] == found[1] && found[0] == found[2] ? "same" : "DIFFERENT");
  const char* label[] = {"reference", "cpu", "cuda"};
  for (std::size_t i = 0; i < t.size(); ++i)
    std::printf("   %-34s median %9.4f ms  p10 %9.4f  p90 %9.4f  ratio %7.1f\n", label[i],
                t[i].median(), t[i].at(0.1), t[i].at(0.9), t[0].median() / t[i].median());
  std::fflush(stdout);
}

void uploads(const std::shared_ptr<CudaSession>& session, std::size_t keyframes) {
  sim::MapWorldOptions world;
  world.keyframes = 60;
  world.features = 1200;
  const sim::SimulatedMap simulated = sim::simulate_map(world);
  const auto snapshot = simulated.map.publish();
  const auto store = resident_store(*session);
  const auto before = store->statistics();
  std::vector<std::shared_ptr<const FeatureSet>> all;
  Times times;
  std::size_t keypoints = 0;
  for (std::size_t i = 0; i < keyframes; ++i) {
    all.push_back(std::make_shared<const FeatureSet>(
        *snapshot->keyframe(KeyframeId(static_cast<std::uint32_t>(i % 60))).data->features));
    keypoints += all.back()->size();
    const Stopwatch watch;
    store->prefetch(all.back());
    times.ms.push_back(watch.elapsed_ms());
  }
  std::vector<Eigen::Vector3f> points(1000000, Eigen::Vector3f(1, 2, 3));
  std::vector<float> distance(points.size(), 1);
  std::vector<Descriptor> descriptor(points.size());
  const auto landmarks = make_resident(Executor::cuda(session),
                                       LandmarkView{points, points, distance, distance, descriptor});
  const auto after = store->statistics();
  std::printf("upload of %zu keyframes of %.0f keypoints, calling thread: median %.1f us, p90 %.1f, p99 %.1f, p99.9 %.1f, max %.1f\n",
              keyframes, static_cast<double>(keypoints) / static_cast<double>(keyframes),
              1000 * times.median(), 1000 * times.at(0.9), 1000 * times.at(0.99),
              1000 * times.at(0.999), 1000 * times.at(1));
  std::printf("device memory with them and 1,000,000 landmarks%s: taken %.1f MiB, reserved %.1f MiB; %.1f kB for a keyframe\n",
              landmarks ? "" : " (NOT UPLOADED)", static_cast<double>(after.bytes_taken) / 1048576.0,
              static_cast<double>(after.bytes_reserved) / 1048576.0,
              static_cast<double>(after.bytes_taken - before.bytes_taken - 64000000) / 1000 /
                  static_cast<double>(keyframes));
  std::fflush(stdout);
}

int main(int argc, char** argv) {
  int repeat = 201;
  bool quick = false;
  for (int i = 1; i < argc; ++i) {
    if (!std::strcmp(argv[i], "--quick")) quick = true;
    if (!std::strcmp(argv[i], "--repeat") && i + 1 < argc) repeat = std::atoi(argv[++i]);
  }
  std::string reason;
  const auto session = CudaSession::open(&reason);
  if (session)
    std::printf("%s\n", cuda_inventory().devices.front().name.c_str());
  else
    std::printf("no device (%s): the rows of cuda are those of the cpu\n", reason.c_str());
  projection(session, "PS1-3, pinhole", repeat, false, 3000, 3, 3, 75);
  projection(session, "fusion, pinhole", repeat, false, 4000, 20, 4, 50);
  projection(session, "fusion, pinhole", repeat, false, 20000, 60, 4, 50);
  bag_of_words(session, repeat, 66);
  if (quick) return 0;
  projection(session, "PS2a, pinhole", repeat, false, 3000, 1, 8, 75);
  projection(session, "PS1-3, fisheye", repeat, true, 3000, 3, 3, 75);
  projection(session, "fusion, fisheye", repeat, true, 4000, 20, 4, 50);
  projection(session, "fusion, fisheye", repeat, true, 20000, 60, 4, 50);
  if (session) uploads(session, 10000);
  return 0;
}

}  // namespace
}  // namespace fastloop

int main(int argc, char** argv) { return fastloop::main(argc, argv); }
