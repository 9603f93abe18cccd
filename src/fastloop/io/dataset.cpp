#include "fastloop/io/dataset.hpp"

#include <algorithm>

#include "fastloop/core/error.hpp"
#include "fastloop/io/dataset_layouts.hpp"
#include "fastloop/io/text.hpp"

namespace fastloop::io {
namespace {

namespace fs = std::filesystem;

constexpr const char* kLayouts =
    "EuRoC or TUM-VI (mav0/cam0, mav0/cam1), TUM RGB-D (rgb.txt, depth.txt) or KITTI odometry "
    "(times.txt, image_0, image_1)";

bool is_image_name(const fs::path& name) {
  const std::string extension = lower_case(name.extension().string());
  return extension == ".png" || extension == ".jpg" || extension == ".jpeg";
}

/// A sequence is easily unpacked one folder deeper than thought.
std::string hint(const fs::path& folder) {
  for (const auto& entry : fs::directory_iterator(folder)) {
    const fs::path& inner = entry.path();
    if (entry.is_directory() &&
        (find_euroc_root(inner) || looks_like_tum_rgbd(inner) || looks_like_kitti(inner)))
      return "; did you mean " + inner.string() + "?";
  }
  return "";
}

}  // namespace

ImageFolder::ImageFolder(fs::path folder) : folder_(std::move(folder)) {
  if (!fs::is_directory(folder_))
    throw InputError(in_file(folder_), "does not exist", "a folder of PNG or JPEG images");
  for (const auto& entry : fs::directory_iterator(folder_))
    if (is_image_name(entry.path())) names_.push_back(entry.path().filename().string());
  if (names_.empty()) throw InputError(in_file(folder_), "holds no images", "PNG or JPEG images");
  std::sort(names_.begin(), names_.end());
}

std::optional<fs::path> ImageFolder::find(const std::string& name) const {
  const std::string stem = fs::path(name).stem().string();
  for (const std::string& candidate : {name, stem + ".png", stem + ".jpg", stem + ".jpeg"})
    if (std::binary_search(names_.begin(), names_.end(), candidate)) return folder_ / candidate;
  return std::nullopt;
}

std::optional<fs::path> first_existing(const std::vector<fs::path>& candidates) {
  for (const fs::path& path : candidates)
    if (fs::exists(path)) return path;
  return std::nullopt;
}

std::unique_ptr<Dataset> open_dataset(const fs::path& folder, const OpenOptions& options) {
  try {
    if (!fs::exists(folder))
      throw InputError(in_file(folder), "does not exist", "a folder with a data set");
    if (!fs::is_directory(folder))
      throw InputError(in_file(folder), "is a file", "a folder with a data set");
    if (fs::is_empty(folder)) throw InputError(in_file(folder), "is empty", kLayouts);
    if (find_euroc_root(folder)) return open_euroc(folder, options);
    if (looks_like_tum_rgbd(folder)) return open_tum_rgbd(folder, options);
    if (looks_like_kitti(folder)) return open_kitti(folder, options);
    throw InputError(in_file(folder), "has none of the known layouts" + hint(folder), kLayouts);
  } catch (const fs::filesystem_error& e) {
    throw InputError(in_file(e.path1().empty() ? folder : e.path1()), e.code().message(),
                     "a readable folder");
  }
}

}  // namespace fastloop::io
