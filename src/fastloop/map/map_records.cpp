#include "fastloop/map/map_records.hpp"

#include <algorithm>

namespace fastloop::map {
namespace {

void put_vector(ByteWriter& w, const auto& vector) {
  w.put_bytes(vector.data(), static_cast<std::size_t>(vector.size()) * sizeof(vector[0]));
}

void put_pose(ByteWriter& w, const SE3& T) {
  put_vector(w, T.rotation.coeffs());
  put_vector(w, T.translation);
}

void put_bias(ByteWriter& w, const ImuBias& bias) {
  put_vector(w, bias.gyro);
  put_vector(w, bias.accel);
}

void put_camera(ByteWriter& w, const Camera& c) {
  w.put(c.model);
  w.put(c.width);
  w.put(c.height);
  for (const double v : {c.fx, c.fy, c.cx, c.cy}) w.put(v);
  for (const double v : c.distortion) w.put(v);
}

void get_vector(RecordReader& r, auto& vector) {
  r.get_bytes(vector.data(), static_cast<std::size_t>(vector.size()) * sizeof(vector[0]));
}

/// Does not normalise: a stored rotation comes back to the last bit.
SE3 get_pose(RecordReader& r) {
  SE3 T;
  get_vector(r, T.rotation.coeffs());
  get_vector(r, T.translation);
  return T;
}

ImuBias get_bias(RecordReader& r) {
  ImuBias bias;
  get_vector(r, bias.gyro);
  get_vector(r, bias.accel);
  return bias;
}

Camera get_camera(RecordReader& r) {
  Camera c;
  c.model = r.get<CameraModel>();
  r.require(c.model == CameraModel::kPinhole || c.model == CameraModel::kKannalaBrandt,
            "unknown camera model");
  c.width = r.get<int>();
  c.height = r.get<int>();
  for (double* v : {&c.fx, &c.fy, &c.cx, &c.cy}) *v = r.get<double>();
  for (double& v : c.distortion) v = r.get<double>();
  r.require(!c.problem(), "a camera has impossible values");
  return c;
}

}  // namespace

void put(ByteWriter& w, const StereoRig& rig) {
  w.put(rig.kind);
  put_camera(w, rig.left);
  put_camera(w, rig.right);
  put_pose(w, rig.T_right_left);
  put_pose(w, rig.T_body_left);
  w.put(rig.baseline_m);
}

StereoRig get_rig(RecordReader& r) {
  StereoRig rig;
  rig.kind = r.get<StereoRig::Kind>();
  r.require(rig.kind == StereoRig::Kind::kRectified || rig.kind == StereoRig::Kind::kGeneral,
            "unknown kind of rig");
  rig.left = get_camera(r);
  rig.right = get_camera(r);
  rig.T_right_left = get_pose(r);
  rig.T_body_left = get_pose(r);
  rig.baseline_m = r.get<double>();
  return rig;
}

void put(ByteWriter& w, const PyramidScales& scales) {
  w.put(scales.levels);
  w.put(scales.factor);
  w.put_all(scales.scale);
  w.put_all(scales.sigma2);
}

PyramidScales get_scales(RecordReader& r) {
  PyramidScales scales;
  scales.levels = r.get<int>();
  scales.factor = r.get<float>();
  r.require(scales.levels >= 1 && scales.levels <= 255, "impossible number of pyramid levels");
  r.get_all(scales.scale, static_cast<std::size_t>(scales.levels));
  r.get_all(scales.sigma2, static_cast<std::size_t>(scales.levels));
  return scales;
}

void put(ByteWriter& w, const MapInfo& info) {
  w.put(info.id.value());
  w.put(info.first_keyframe.value());
  w.put(info.last_keyframe.value());
  w.put(info.merged_into.value());
  w.put<std::uint64_t>(info.num_keyframes);
  w.put(info.imu_refinements);
  w.put(info.imu_initialized);
}

MapInfo get_map_info(RecordReader& r, const MapSizes& sizes) {
  MapInfo info;
  info.id = r.id<MapId>(sizes.maps, false);
  info.first_keyframe = r.id<KeyframeId>(sizes.keyframes);
  info.last_keyframe = r.id<KeyframeId>(sizes.keyframes);
  info.merged_into = r.id<MapId>(sizes.maps);
  info.num_keyframes = r.get<std::uint64_t>();
  info.imu_refinements = r.get<int>();
  info.imu_initialized = r.flag();
  return info;
}

void put(ByteWriter& w, const LoopEdge& edge) {
  w.put(edge.a.value());
  w.put(edge.b.value());
  put_pose(w, edge.T_a_b);
}

LoopEdge get_loop_edge(RecordReader& r, const MapSizes& sizes) {
  LoopEdge edge;
  edge.a = r.id<KeyframeId>(sizes.keyframes, false);
  edge.b = r.id<KeyframeId>(sizes.keyframes, false);
  edge.T_a_b = get_pose(r);
  return edge;
}

void put(ByteWriter& w, const Keyframe& k) {
  w.put(k.data->frame.value());
  w.put(k.data->stamp_ns);
  w.put(k.map.value());
  put_pose(w, k.state.T_world_body);
  put_vector(w, k.state.v_world);
  put_bias(w, k.state.bias);
  for (const KeyframeId id : {k.parent, k.previous, k.next}) w.put(id.value());
  w.put(k.removed);
  w.put(k.anchor_of_removed.value());
  put_pose(w, k.T_anchor_body);
  w.put(k.data->features != nullptr);
  w.put(k.imu_from_previous != nullptr);
}

KeyframeEntry get_keyframe(RecordReader& r, const MapSizes& sizes) {
  KeyframeEntry entry;
  entry.data = std::make_shared<KeyframeData>();
  entry.data->frame = FrameId(r.get<std::uint32_t>());
  entry.data->stamp_ns = r.get<Nanoseconds>();
  Keyframe& k = entry.keyframe;
  k.data = entry.data;
  k.map = r.id<MapId>(sizes.maps, false);
  k.state.T_world_body = get_pose(r);
  get_vector(r, k.state.v_world);
  k.state.bias = get_bias(r);
  for (KeyframeId* id : {&k.parent, &k.previous, &k.next}) *id = r.id<KeyframeId>(sizes.keyframes);
  k.removed = r.flag();
  k.anchor_of_removed = r.id<KeyframeId>(sizes.keyframes, !k.removed);
  k.T_anchor_body = get_pose(r);
  entry.has_features = r.flag();
  entry.has_imu = r.flag();
  r.require(k.removed || entry.has_features, "a live keyframe has no features");
  return entry;
}

void put(ByteWriter& w, const FeatureSet& f) {
  const std::size_t n = f.size();
  for (const std::size_t size :
       {f.y.size(), f.angle_rad.size(), f.octave.size(), f.descriptors.size(), f.right_x.size(),
        f.right_y.size(), f.depth_m.size(), f.grid.indices.size()})
    if (size != n) throw InvalidArgument("the arrays of a feature set differ in length");
  if (f.image_width <= 0 || f.image_height <= 0)
    throw InvalidArgument("a feature set has no image size");
  w.put(static_cast<std::uint32_t>(n));
  w.put(f.image_width);
  w.put(f.image_height);
  for (const auto* v : {&f.x, &f.y, &f.angle_rad, &f.right_x, &f.right_y, &f.depth_m})
    w.put_all(*v);
  w.put_all(f.octave);
  w.put_all(f.descriptors);
}

std::shared_ptr<const FeatureSet> get_features(RecordReader& r, int levels) {
  auto f = std::make_shared<FeatureSet>();
  const auto n = r.get<std::uint32_t>();
  r.require(n <= 0xffff, "a keyframe has more than 65,535 keypoints");
  f->image_width = r.get<int>();
  f->image_height = r.get<int>();
  for (auto* v : {&f->x, &f->y, &f->angle_rad, &f->right_x, &f->right_y, &f->depth_m})
    r.get_all(*v, n);
  r.get_all(f->octave, n);
  r.get_all(f->descriptors, n);
  r.require(std::all_of(f->octave.begin(), f->octave.end(), [&](int o) { return o < levels; }),
            "a keypoint lies above the pyramid");
  f->grid.build(f->x, f->y, f->image_width, f->image_height);
  return f;
}

void put(ByteWriter& w, const PreintegratedImu& imu) {
  w.put(imu.begin_ns());
  w.put(imu.end_ns());
  put_bias(w, imu.bias());
  const ImuCalibration& c = imu.noise();
  for (const double v : {c.rate_hz, c.gyro_noise_density, c.gyro_random_walk, c.accel_noise_density,
                         c.accel_random_walk, c.time_shift_s})
    w.put(v);
  w.put(static_cast<std::uint32_t>(imu.samples().size()));
  for (const ImuSample& s : imu.samples()) {
    w.put(s.stamp_ns);
    put_vector(w, s.gyro);
    put_vector(w, s.accel);
  }
}

std::shared_ptr<const PreintegratedImu> get_imu(RecordReader& r) {
  const auto begin_ns = r.get<Nanoseconds>();
  const auto end_ns = r.get<Nanoseconds>();
  const ImuBias bias = get_bias(r);
  ImuCalibration c;
  for (double* v : {&c.rate_hz, &c.gyro_noise_density, &c.gyro_random_walk, &c.accel_noise_density,
                    &c.accel_random_walk, &c.time_shift_s})
    *v = r.get<double>();
  const auto count = r.get<std::uint32_t>();
  std::vector<ImuSample> samples;
  for (std::uint32_t i = 0; i < count; ++i) {  // grows with what is really there
    ImuSample s;
    s.stamp_ns = r.get<Nanoseconds>();
    get_vector(r, s.gyro);
    get_vector(r, s.accel);
    samples.push_back(s);
  }
  // The samples kept begin and end exactly with the interval, so they integrate to the same.
  return std::make_shared<PreintegratedImu>(samples, begin_ns, end_ns, bias, c);
}

void put(ByteWriter& w, const Landmark& l) {
  w.put(l.anchor.value());
  w.put(l.replaced_by.value());
  put_vector(w, l.p_anchor);
  put_vector(w, l.normal_anchor);
  w.put(l.min_distance_m);
  w.put(l.max_distance_m);
  w.put_bytes(&l.descriptor, sizeof(l.descriptor));
  w.put(l.first_keyframe.value());
  w.put(l.visible);
  w.put(l.found);
  w.put(static_cast<std::uint32_t>(l.observations.size()));
  for (const Observation& o : l.observations) {
    w.put(o.keyframe.value());
    w.put(o.keypoint);
  }
}

Landmark get_landmark(RecordReader& r, const MapSizes& sizes) {
  Landmark l;
  l.anchor = r.id<KeyframeId>(sizes.keyframes);
  l.replaced_by = r.id<LandmarkId>(sizes.landmarks);
  get_vector(r, l.p_anchor);
  get_vector(r, l.normal_anchor);
  l.min_distance_m = r.get<float>();
  l.max_distance_m = r.get<float>();
  r.get_bytes(&l.descriptor, sizeof(l.descriptor));
  l.first_keyframe = r.id<KeyframeId>(sizes.keyframes);
  l.visible = r.get<std::uint32_t>();
  l.found = r.get<std::uint32_t>();
  const auto count = r.get<std::uint32_t>();
  r.require_room(count, 2 * sizeof(std::uint32_t));
  l.observations.resize(count);
  for (Observation& o : l.observations) {
    o.keyframe = r.id<KeyframeId>(sizes.keyframes, false);
    o.keypoint = r.get<std::uint32_t>();
  }
  return l;
}

void put(ByteWriter& w, const std::vector<LandmarkId>& landmarks) {
  w.put(static_cast<std::uint32_t>(landmarks.size()));
  for (const LandmarkId id : landmarks) w.put(id.value());
}

std::vector<LandmarkId> get_landmark_ids(RecordReader& r, const MapSizes& sizes) {
  const auto count = r.get<std::uint32_t>();
  r.require_room(count, sizeof(std::uint32_t));
  std::vector<LandmarkId> ids(count);
  for (LandmarkId& id : ids) id = r.id<LandmarkId>(sizes.landmarks);
  return ids;
}

void put(ByteWriter& w, const std::vector<CovisibilityEdge>& edges) {
  w.put(static_cast<std::uint32_t>(edges.size()));
  for (const CovisibilityEdge& e : edges) {
    w.put(e.keyframe.value());
    w.put(e.shared);
  }
}

std::vector<CovisibilityEdge> get_covisible(RecordReader& r, const MapSizes& sizes) {
  const auto count = r.get<std::uint32_t>();
  r.require_room(count, 2 * sizeof(std::uint32_t));
  std::vector<CovisibilityEdge> edges(count);
  for (CovisibilityEdge& e : edges) {
    e.keyframe = r.id<KeyframeId>(sizes.keyframes, false);
    e.shared = r.get<std::int32_t>();
  }
  return edges;
}

void RecordReader::section(const std::string& name) {
  require(bytes_.empty(), "there is more than there should be");
  name_ = name;
}

void RecordReader::next_block() {
  end_ = end_ || !file_.next();
  require(!end_, "there is less than there should be");
  require(file_.header().text() == name_, "the blocks are in another order");
  bytes_ = file_.unpack();
  require(!bytes_.empty(), "a block is empty");
}

void RecordReader::entry() {
  if (bytes_.empty()) next_block();
}

void RecordReader::finish() {
  require(bytes_.empty() && !file_.next(), "there is more than there should be");
}

bool RecordReader::flag() {
  const auto value = get<std::uint8_t>();
  require(value <= 1, "a yes or no is neither");
  return value == 1;
}

void RecordReader::get_bytes(void* data, std::size_t bytes) {
  require(bytes <= bytes_.size(), "an entry is longer than its block");
  if (bytes > 0) std::memcpy(data, bytes_.data(), bytes);
  bytes_ = bytes_.subspan(bytes);
}

}  // namespace fastloop::map
