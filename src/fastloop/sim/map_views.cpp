#include "fastloop/sim/map_views.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "fastloop/place/default_vocabulary.hpp"

namespace fastloop::sim {
namespace {

constexpr double kBorder = 16;             // pixels without keypoints at the image's edge
constexpr double kMaxFisheyeAngle = 1.35;  // radians from the axis
constexpr double kMinDepth = 0.3;
constexpr double kMinDisparity = 1.0;  // pixels; nearer to zero there is no stereo match
constexpr int kWordBits = 16;          // a world point's descriptor differs so much from its word

Descriptor with_flips(Descriptor d, int flips, Random& random) {
  for (int i = 0; i < flips; ++i) {
    const auto bit = static_cast<unsigned>(random.integer(256));
    d.words[bit / 64] ^= std::uint64_t{1} << (bit % 64);
  }
  return d;
}

float wrapped(double angle) {
  const double turn = 2 * M_PI;
  const auto a = static_cast<float>(angle - turn * std::floor(angle / turn));
  return a < static_cast<float>(turn) ? a : 0.f;
}

}  // namespace

ViewModel::ViewModel(const MapWorldOptions& options, const StereoRig& rig, double window)
    : options_(options), rig_(rig), window_(window) {
  const place::VocabularyTree& tree = place::default_vocabulary().tree();
  for (std::size_t n = 1; n < tree.size(); ++n)
    if (tree.is_leaf(n)) leaves_.push_back(static_cast<std::uint32_t>(n));
}

Descriptor ViewModel::word(Random& random) const {
  const std::uint32_t leaf =
      leaves_[static_cast<std::size_t>(random.integer(static_cast<int>(leaves_.size())))];
  return with_flips(place::default_vocabulary().tree().descriptor[leaf], kWordBits, random);
}

WorldPoint ViewModel::make_point(const SE3& T_world_body, double home, Random& random) const {
  const Camera& camera = rig_.left;
  const SE3 T_world_left = T_world_body * rig_.T_body_left;
  Vector3d ray;
  do {
    ray = camera.unproject({random.uniform(kBorder, camera.width - 1 - kBorder),
                            random.uniform(kBorder, camera.height - 1 - kBorder)});
  } while (std::acos(ray.z()) > kMaxFisheyeAngle);
  WorldPoint point;
  // As many points in each doubling of the distance.
  const double distance = std::exp(random.uniform(std::log(2.5), std::log(15.0)));
  point.p_world = T_world_left * Vector3d(distance * ray);
  point.home = home;
  point.before = static_cast<float>(window_ * random.uniform(0.4, 1));
  point.behind = static_cast<float>(window_ * random.uniform(0.4, 1));
  // Half of the points at the lowest octave, half of the rest at the next one and so on.
  int octave = 0;
  while (octave < scales_.levels - 1 && random.integer(2)) ++octave;
  point.farthest_m = static_cast<float>(distance * scales_.scale[octave] * random.uniform(1, 1.2));
  point.angle_rad = static_cast<float>(random.uniform(0, 2 * M_PI));
  point.descriptor = word(random);
  return point;
}

std::optional<PointSighting> ViewModel::see(const WorldPoint& point,
                                            const SE3& T_left_world) const {
  PointSighting s;
  s.p_left = T_left_world * point.p_world;
  const double distance = s.p_left.norm();
  if (s.p_left.z() < kMinDepth || !(s.p_left.z() > std::cos(kMaxFisheyeAngle) * distance))
    return std::nullopt;
  s.pixel = rig_.left.project(s.p_left);
  if (!rig_.left.contains(s.pixel, kBorder)) return std::nullopt;
  const double level = std::log(point.farthest_m / distance) / std::log(scales_.factor);
  if (level < -0.5 || level > scales_.levels - 0.5) return std::nullopt;
  s.octave = std::clamp(static_cast<int>(std::floor(level)), 0, scales_.levels - 1);
  return s;
}

double ViewModel::mean_sightings(const SE3& T_carrier_body, double step) const {
  constexpr int kPoints = 1000;
  Random random(1);
  int seen = 0;
  for (int i = 0; i < kPoints; ++i) {
    const WorldPoint point = make_point(T_carrier_body, 0, random);
    const double first = -point.before + step * random.uniform();
    for (double x = first; x <= point.behind; x += step) {
      const SE3 T_world_body(T_carrier_body.rotation, Vector3d(x, 0, 0));
      seen += see(point, (T_world_body * rig_.T_body_left).inverse()).has_value();
    }
  }
  return std::max(1.0, static_cast<double>(seen) / kPoints);
}

void ViewModel::add_right(FeatureSet& f, const PointSighting& s, double sigma,
                          Random& random) const {
  constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
  f.right_x.push_back(kNan);
  f.right_y.push_back(kNan);
  f.depth_m.push_back(0);
  const double focal_baseline = rig_.left.fx * rig_.baseline_m;
  const double disparity = focal_baseline / s.p_left.z();
  const double noise = sigma * random.normal(), noise_v = sigma * random.normal();
  if (disparity < kMinDisparity || disparity + noise < 0.5 * kMinDisparity) return;
  if (rig_.kind == StereoRig::Kind::kRectified) {
    const double right = f.x.back() - disparity - noise;
    if (right < 0) return;
    f.right_x.back() = static_cast<float>(right);
    f.right_y.back() = f.y.back();
  } else {
    const Vector3d p_right = rig_.T_right_left * s.p_left;
    if (!rig_.right.is_projectable(p_right)) return;
    const Eigen::Vector2d pixel = rig_.right.project(p_right);
    if (!rig_.right.contains(pixel, kBorder)) return;
    f.right_x.back() = static_cast<float>(pixel.x() + noise);
    f.right_y.back() = static_cast<float>(pixel.y() + noise_v);
  }
  f.depth_m.back() = static_cast<float>(focal_baseline / (disparity + noise));
}

void ViewModel::add(FeatureSet& f, const PointSighting& s, float angle,
                    const Descriptor& descriptor, Random& random) const {
  const double sigma = options_.noise_px * scales_.scale[s.octave];
  const auto inside = [](double v, int extent) {
    return static_cast<float>(std::clamp(v, 0.0, extent - 1.0));
  };
  f.x.push_back(inside(s.pixel.x() + sigma * random.normal(), rig_.left.width));
  f.y.push_back(inside(s.pixel.y() + sigma * random.normal(), rig_.left.height));
  f.angle_rad.push_back(wrapped(angle + 0.05 * random.normal()));
  f.octave.push_back(static_cast<std::uint8_t>(s.octave));
  // Half to three halves of the mean.
  const int flips = options_.flipped_bits == 0
                        ? 0
                        : options_.flipped_bits / 2 + random.integer(options_.flipped_bits + 1);
  f.descriptors.push_back(with_flips(descriptor, flips, random));
  add_right(f, s, sigma, random);
}

void ViewModel::add_nothing(FeatureSet& f, Random& random) const {
  PointSighting s;
  Vector3d ray;
  do {
    s.pixel = {random.uniform(kBorder, rig_.left.width - 1 - kBorder),
               random.uniform(kBorder, rig_.left.height - 1 - kBorder)};
    ray = rig_.left.unproject(s.pixel);
  } while (std::acos(ray.z()) > kMaxFisheyeAngle);
  s.p_left = random.uniform(1, 15) * ray;
  while (s.octave < scales_.levels - 1 && random.integer(2)) ++s.octave;
  const auto angle = static_cast<float>(random.uniform(0, 2 * M_PI));
  add(f, s, angle, word(random), random);
}

std::pair<std::shared_ptr<FeatureSet>, std::vector<ViewModel::SlotKeypoint>> ViewModel::view(
    const RouteStop& stop, std::span<const Appearance> near, std::span<const WorldPoint> points,
    Random random) const {
  const SE3 T_left_world = (stop.T_world_body * rig_.T_body_left).inverse();
  // Roll of the camera about its axis against the road, seen in where the vertical points.
  const Vector3d down = T_left_world.rotation * Vector3d(0, 0, -1);
  const double roll = std::atan2(down.y(), down.x());
  std::vector<std::pair<PointSighting, const Appearance*>> seen;
  for (const Appearance& a : near) {
    const WorldPoint& point = points[a.point];
    if (stop.way < a.way - point.before || stop.way > a.way + point.behind) continue;
    if (const auto sighting = see(point, T_left_world)) seen.emplace_back(*sighting, &a);
  }
  const auto total = static_cast<std::size_t>(options_.features);
  const std::size_t room = total - total / 10;
  auto features = std::make_shared<FeatureSet>();
  std::vector<SlotKeypoint> keypoints;
  const double keep =
      seen.size() <= room ? 1 : static_cast<double>(room) / static_cast<double>(seen.size());
  for (const auto& [sighting, a] : seen) {
    if (random.uniform() >= keep || features->size() >= total) continue;
    while (features->size() + room < total + keypoints.size() && random.integer(3) == 0)
      add_nothing(*features, random);
    keypoints.push_back({a->slot, static_cast<std::uint32_t>(features->size())});
    const WorldPoint& point = points[a->point];
    add(*features, sighting, static_cast<float>(point.angle_rad + roll), point.descriptor, random);
  }
  while (features->size() < total) add_nothing(*features, random);
  features->image_width = rig_.left.width;
  features->image_height = rig_.left.height;
  features->grid.build(features->x, features->y, rig_.left.width, rig_.left.height);
  return {features, keypoints};
}

}  // namespace fastloop::sim
