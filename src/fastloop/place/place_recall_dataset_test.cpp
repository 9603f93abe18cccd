#include <gtest/gtest.h>

#include <algorithm>
#include <charconv>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
#include <opencv2/core/utility.hpp>
#include <opencv2/imgcodecs.hpp>
#include <sstream>

#include "fastloop/core/time.hpp"
#include "fastloop/features/orb_extractor.hpp"
#include "fastloop/geometry/se3.hpp"
#include "fastloop/place/candidate_ranking.hpp"
#include "fastloop/place/default_vocabulary.hpp"
#include "fastloop/place/inverted_index.hpp"
#include "fastloop/place/vocabulary_io.hpp"

namespace fastloop::place {
namespace {

namespace fs = std::filesystem;

fs::path data_folder() {
  const char* given = std::getenv("FASTLOOP_DATA");
  return fs::path(given ? given : FASTLOOP_DEFAULT_DATA) / "euroc_v101_sparse";
}

/// FASTLOOP_TEST_VOCABULARY names another vocabulary to measure instead of the one that ships.
Vocabulary vocabulary_under_test() {
  const char* other = std::getenv("FASTLOOP_TEST_VOCABULARY");
  return other ? Vocabulary(load_any_vocabulary(other)) : default_vocabulary();
}

struct View {
  Nanoseconds stamp_ns;
  SE3 T_world_camera;
  FeatureSet features;  ///< descriptors and orientations
  BagOfWords bag;
};

/// Poses "stamp_ns x y z qw qx qy qz" with blanks or commas.
std::map<Nanoseconds, SE3> read_poses(const fs::path& file) {
  std::ifstream in(file);
  std::map<Nanoseconds, SE3> poses;
  for (std::string line; std::getline(in, line);) {
    if (line.empty() || line[0] == '#') continue;
    std::replace(line.begin(), line.end(), ',', ' ');
    std::istringstream row(line);
    double stamp, x, y, z, qw, qx, qy, qz;
    if (row >> stamp >> x >> y >> z >> qw >> qx >> qy >> qz)
      poses.emplace(static_cast<Nanoseconds>(stamp),
                    SE3(Eigen::Quaterniond(qw, qx, qy, qz), Vector3d(x, y, z)));
  }
  return poses;
}

std::vector<View> read_views(const fs::path& folder) {
  cv::setNumThreads(1);  // as FrameBuilder has it
  const auto poses = read_poses(folder / "V101_GT_left_cam.txt");
  std::vector<View> views;
  OrbOptions options;
  options.num_features = 1200;
  OrbExtractor extractor(options);
  std::vector<fs::path> files;
  for (const auto& entry : fs::directory_iterator(folder / "mav0/cam0/data"))
    files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  for (const fs::path& file : files) {
    const std::string stem = file.stem().string();
    Nanoseconds stamp = 0;
    std::from_chars(stem.data(), stem.data() + stem.size(), stamp);
    auto pose = poses.lower_bound(stamp);
    if (pose != poses.begin() &&
        (pose == poses.end() || stamp - std::prev(pose)->first < pose->first - stamp))
      --pose;
    if (std::abs(pose->first - stamp) > 30'000'000) continue;  // no ground truth there
    const cv::Mat read = cv::imread(file.string(), cv::IMREAD_GRAYSCALE);
    ImageU8 image(read.cols, read.rows);
    for (int y = 0; y < read.rows; ++y) std::copy_n(read.ptr(y), read.cols, image.row(y));
    View view{stamp, pose->second, {}, {}};
    OrbFeatures orb = extractor.extract(image);
    view.features.x = std::move(orb.x);
    view.features.angle_rad = std::move(orb.angle_rad);
    view.features.descriptors = std::move(orb.descriptors);
    views.push_back(std::move(view));
  }
  return views;
}

bool apart(const View& a, const View& b) {
  return std::abs(a.stamp_ns - b.stamp_ns) > 10'000'000'000;
}

bool revisit(const View& a, const View& b) {
  return apart(a, b) &&
         (a.T_world_camera.translation - b.T_world_camera.translation).norm() <= 1.0 &&
         angle_between(a.T_world_camera, b.T_world_camera) <= 20 * M_PI / 180;
}

struct Recall {
  int queries = 0, first = 0, in_three = 0;
  void print(const char* what) const {
    std::printf(
        "%s: %d queries with a revisit; first candidate right %d, one of the first three %d (%.0f "
        "%%)\n",
        what, queries, first, in_three, 100.0 * in_three / queries);
  }
};

/// Every view against those more than 10 s away. A query counts as answered when one of its first
/// three candidates is a revisit within 1 m and 20 degrees.
Recall measure(const std::vector<View>& views, const InvertedIndex& index, bool ranked) {
  const auto side = [&](std::size_t i) {
    return matching::MatchSide{&views[i].features, &views[i].bag.groups, {}};
  };
  QueryOptions options;
  if (ranked) options.min_shared_ratio = kSharedRatioBeforeRanking;
  Recall recall;
  for (const View& view : views) {
    std::vector<KeyframeId> near;
    int revisits = 0;
    for (std::uint32_t k = 0; k < views.size(); ++k) {
      if (!apart(view, views[k])) near.emplace_back(k);
      revisits += revisit(view, views[k]);
    }
    if (revisits == 0) continue;
    ++recall.queries;
    auto found = index.query(
        view.bag.vector, near, [](KeyframeId) { return std::vector<KeyframeId>(); }, options);
    if (ranked) {
      const auto order = rank_by_matches(Executor::cpu(), side(&view - views.data()), found,
                                         [&](KeyframeId id) { return side(id.value()); });
      found.clear();
      for (const RankedCandidate& r : order) found.push_back(r.candidate);
    }
    for (std::size_t c = 0; c < found.size() && c < 3; ++c) {
      if (!revisit(view, views[found[c].keyframe.value()])) continue;
      recall.first += c == 0;
      ++recall.in_three;
      break;
    }
  }
  return recall;
}

TEST(PlaceRecall, RevisitsOfV101AreAmongTheFirstThreeCandidates) {
  const fs::path folder = data_folder();
  if (!fs::exists(folder)) GTEST_SKIP() << folder << " is absent";
  std::vector<View> views = read_views(folder);
  ASSERT_GT(views.size(), 90u);
  const Vocabulary vocabulary = vocabulary_under_test();
  InvertedIndex index(vocabulary.num_words());
  for (std::size_t i = 0; i < views.size(); ++i) {
    views[i].bag = vocabulary.transform(views[i].features.descriptors);
    index.insert(KeyframeId(static_cast<std::uint32_t>(i)), views[i].bag.vector);
  }
  std::printf("%zu words\n", vocabulary.num_words());
  const Recall words = measure(views, index, false), ranked = measure(views, index, true);
  words.print("by words alone");
  ranked.print("the first twenty ranked by descriptor matches");
  EXPECT_GT(words.queries, 10);
  EXPECT_GE(words.in_three, 0.6 * words.queries);
  EXPECT_GE(ranked.in_three, 0.8 * ranked.queries);
}

}  // namespace
}  // namespace fastloop::place
