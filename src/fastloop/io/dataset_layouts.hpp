#pragma once

#include "fastloop/io/dataset.hpp"

/// One reader per layout; `open_dataset` picks. Each `looks_like_*` only glances at names.
namespace fastloop::io {

/// EuRoC ASL and TUM-VI exports: the folder that holds cam0 (the given one or its mav0), if there
/// is one.
std::optional<std::filesystem::path> find_euroc_root(const std::filesystem::path& folder);
std::unique_ptr<Dataset> open_euroc(const std::filesystem::path& folder,
                                    const OpenOptions& options);

bool looks_like_tum_rgbd(const std::filesystem::path& folder);
std::unique_ptr<Dataset> open_tum_rgbd(const std::filesystem::path& folder,
                                       const OpenOptions& options);

bool looks_like_kitti(const std::filesystem::path& folder);
std::unique_ptr<Dataset> open_kitti(const std::filesystem::path& folder,
                                    const OpenOptions& options);

/// Paths of images in a folder, by file name. A name listed with another extension (png, jpg, jpeg)
/// is found too.
class ImageFolder {
 public:
  explicit ImageFolder(std::filesystem::path folder);
  std::optional<std::filesystem::path> find(const std::string& name) const;
  /// All PNG and JPEG files, sorted by name.
  const std::vector<std::string>& names() const { return names_; }
  const std::filesystem::path& path() const { return folder_; }

 private:
  std::filesystem::path folder_;
  std::vector<std::string> names_;
};

/// The first of these paths that exists.
std::optional<std::filesystem::path> first_existing(
    const std::vector<std::filesystem::path>& candidates);

}  // namespace fastloop::io
