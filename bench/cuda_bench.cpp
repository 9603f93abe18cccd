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
#include "fastloop/matching/scene_for_tests.hpp"
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

/// A hall that was mapped densely: landmarks on its walls, seen by keyframes near its middle that
/// look in all directions. Every landmark whose direction a keyframe covers is in view.
struct Hall {
  StereoRig rig;
  PyramidScales scales;
  map::LandmarkArrays cloud;
  std::vector<std::shared_ptr<FeatureSet>> features;
  std::vector<SearchTarget> targets;
};

Hall make_hall(bool fisheye, std::size_t landmarks, std::size_t num_targets) {
  std::mt19937 rng(1);
  std::uniform_real_distribution<double> u(-1, 1);
  Hall hall;
  hall.rig = fisheye ? matching::testing::fisheye_rig() : matching::testing::pinhole_rig();
  for (std::size_t i = 0; i < landmarks; ++i) {
    const double angle = M_PI * u(rng);
    const Vector3d p(8 * std::cos(angle), 2.5 * u(rng), 8 * std::sin(angle));
    hall.cloud.ids.push_back(LandmarkId(static_cast<std::uint32_t>(i)));
    hall.cloud.p_world.push_back(p.cast<float>());
    hall.cloud.normal_world.push_back(p.normalized().cast<float>());
    const float farthest = static_cast<float>(p.norm()) * hall.scales.scale[1 + rng() % 4];
    hall.cloud.max_distance_m.push_back(farthest);
    hall.cloud.min_distance_m.push_back(farthest / hall.scales.scale.back());
    hall.cloud.descriptor.push_back(matching::testing::random_descriptor(rng));
  }
  for (std::size_t t = 0; t < num_targets; ++t) {
    const SE3 T_world_camera(so3::exp({0, M_PI * u(rng), 0}),
                             Vector3d(u(rng), 0.3 * u(rng), u(rng)));
    const SE3 T_camera_world = T_world_camera.inverse();
    auto f = std::make_shared<FeatureSet>();
    for (int tries = 0; tries < 40000 && f->size() < 1200; ++tries) {
      const std::size_t i = rng() % landmarks;
      const Vector3d p = T_camera_world * hall.cloud.p_world[i].cast<double>();
      if (!hall.rig.left.is_projectable(p)) continue;
      const Eigen::Vector2d pixel = hall.rig.left.project(p) + 1.5 * Eigen::Vector2d(u(rng), u(rng));
      if (!hall.rig.left.contains(pixel)) continue;
      const double ratio = hall.cloud.max_distance_m[i] / p.norm();
      const int level = std::clamp(static_cast<int>(std::ceil(std::log(ratio) / std::log(1.2))), 0, 7);
      matching::testing::add_keypoint(
          *f, pixel.x(), pixel.y(), std::max(0, level - static_cast<int>(rng() % 2)),
          matching::testing::with_flipped_bits(hall.cloud.descriptor[i], 10, rng));
    }
    matching::testing::finish(*f, hall.rig.left);
    hall.features.push_back(f);
    hall.targets.push_back({f.get(), T_camera_world, 1, {}, {}});
  }
  return hall;
}

bool equal(const ProjectionMatches& a, const ProjectionMatches& b) {
  return a.keypoint == b.keypoint && a.distance == b.distance && a.in_view == b.in_view;
}

void compare(const std::shared_ptr<CudaSession>& session, const char* name, int repeat,
             const StereoRig& rig, const PyramidScales& scales,
             std::span<const SearchTarget> targets, const map::LandmarkArrays& cloud,
             float radius_px, int max_distance) {
  const Executor device = Executor::cuda(session);
  const std::size_t num_targets = targets.size();
  LandmarkView view = cloud.view();
  ProjectionSearchOptions rule;
  rule.radius_px = radius_px;
  rule.max_distance = max_distance;
  std::vector<std::vector<ProjectionMatches>> found(3);
  for (auto& f : found) f.resize(num_targets);
  const auto dense = [&](const Executor& e, std::size_t slot) {
    search_by_projection(e, rig, scales, targets, view, rule, found[slot]);
  };
  std::vector<MatchLists> lists(4);
  const auto compact = [&](const Executor& e, const LandmarkView& l, std::size_t slot) {
    const ProjectionJob job{l, targets};
    lists[slot] = find_by_projection(e, rig, scales, {&job, 1}, rule);
  };
  const auto resident = make_resident(device, view);
  LandmarkView on_device = view;
  on_device.resident = resident.get();
  auto t = alternate(repeat, {[&] { dense(Executor::reference(), 0); },
                              [&] { compact(Executor::reference(), view, 3); },
                              [&] { dense(Executor::cpu(), 1); },
                              [&] { compact(Executor::cpu(), view, 0); },
                              [&] { dense(device, 2); },
                              [&] { compact(device, view, 1); },
                              [&] { compact(device, on_device, 2); }});
  bool same = true;
  for (const MatchLists& l : lists) same = same && l.matches == lists[0].matches;
  std::size_t seen = 0;
  for (std::size_t i = 0; i < num_targets; ++i) {
    same = same && equal(found[0][i], found[1][i]) && equal(found[0][i], found[2][i]);
    for (const std::uint8_t s : found[0][i].in_view) seen += s;
  }
  const double reference = t[0].median();
  std::printf("%-22s %6zu x %2zu  in view %4.1f %%  matches %6zu  %s\n", name, view.size(),
              num_targets,
              100.0 * static_cast<double>(seen) / static_cast<double>(view.size() * num_targets),
              lists[0].matches.size(), same ? "same" : "DIFFERENT");
  const char* label[] = {"reference", "reference, lists", "cpu", "cpu, lists", "cuda", "cuda, lists",
                         "cuda, lists, landmarks resident"};
  for (std::size_t i = 0; i < t.size(); ++i)
    std::printf("   %-34s median %9.4f ms  p10 %9.4f  p90 %9.4f  ratio %7.1f\n", label[i],
                t[i].median(), t[i].at(0.1), t[i].at(0.9), reference / t[i].median());
  std::fflush(stdout);
}

void in_map(const std::shared_ptr<CudaSession>& session, const char* name, int repeat, bool fisheye,
            std::size_t landmarks, std::size_t num_targets, float radius_px, int max_distance) {
  sim::MapWorldOptions world;
  world.keyframes = 400;
  world.features = 1200;
  world.fisheye = fisheye;
  const Place place = make_place(world, landmarks, num_targets);
  const auto snapshot = place.simulated.map.publish();
  for (std::uint32_t k = 0; k < snapshot->keyframe_slots(); ++k)
    make_resident(Executor::cuda(session), snapshot->keyframe(KeyframeId(k)).data->features);
  compare(session, name, repeat, snapshot->rig(), snapshot->scales(), place.targets, place.cloud,
          radius_px, max_distance);
}

void in_hall(const std::shared_ptr<CudaSession>& session, const char* name, int repeat, bool fisheye,
             std::size_t landmarks, std::size_t num_targets, float radius_px, int max_distance) {
  const Hall hall = make_hall(fisheye, landmarks, num_targets);
  for (const auto& f : hall.features) make_resident(Executor::cuda(session), f);
  compare(session, name, repeat, hall.rig, hall.scales, hall.targets, hall.cloud, radius_px,
          max_distance);
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
  // As the place database holds them: known not to change, resident after the first call.
  own.id.assign();
  for (const FeatureGroups& g : groups) g.id.assign();
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
  in_map(session, "map, pinhole", repeat, false, 3000, 3, 3, 75);
  in_map(session, "map, pinhole", repeat, false, 4000, 20, 4, 50);
  in_map(session, "map, pinhole", repeat, false, 20000, 60, 4, 50);
  in_hall(session, "hall, pinhole", repeat, false, 20000, 60, 4, 50);
  bag_of_words(session, repeat, 66);
  if (quick) return 0;
  in_map(session, "map, pinhole, PS2a", repeat, false, 3000, 1, 8, 75);
  in_map(session, "map, fisheye", repeat, true, 3000, 3, 3, 75);
  in_map(session, "map, fisheye", repeat, true, 4000, 20, 4, 50);
  in_map(session, "map, fisheye", repeat, true, 20000, 60, 4, 50);
  in_hall(session, "hall, pinhole", repeat, false, 3000, 3, 3, 75);
  in_hall(session, "hall, fisheye", repeat, true, 20000, 60, 4, 50);
  if (session) uploads(session, 10000);
  return 0;
}

}  // namespace
}  // namespace fastloop

int main(int argc, char** argv) { return fastloop::main(argc, argv); }
