#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <iostream>
#include <limits>
#include <memory>

#include "commands.hpp"
#include "fastloop/io/map_export.hpp"
#include "fastloop/map/map_file.hpp"

namespace fastloop::apps {
namespace {

namespace fs = std::filesystem;

struct Arguments {
  std::string file, out;
};

void print_counts(const map::Snapshot& m) {
  std::size_t keypoints = 0, seen = 0, imu = 0, neighbours = 0;
  for (std::uint32_t i = 0; i < m.keyframe_slots(); ++i) {
    const map::Keyframe& k = m.keyframe(KeyframeId(i));
    if (k.removed) continue;
    keypoints += k.landmarks.size();
    seen += static_cast<std::size_t>(std::count_if(k.landmarks.begin(), k.landmarks.end(),
                                                   [](LandmarkId l) { return l.valid(); }));
    imu += k.imu_from_previous != nullptr;
    neighbours += m.covisible(KeyframeId(i)).size();
  }
  const auto each = [&](std::size_t count) {
    return m.num_keyframes() == 0
               ? 0.0
               : static_cast<double>(count) / static_cast<double>(m.num_keyframes());
  };
  std::printf("keyframes     %zu (%zu removed)\n", m.num_keyframes(),
              m.keyframe_slots() - m.num_keyframes());
  std::printf("landmarks     %zu (%zu removed or merged)\n", m.num_landmarks(),
              m.landmark_slots() - m.num_landmarks());
  std::printf("observations  %zu, %.1f of %.1f keypoints a keyframe\n", seen, each(seen),
              each(keypoints));
  std::printf("covisible     %.1f keyframes with each\n", each(neighbours));
  std::printf("IMU           between %zu pairs of keyframes\n", imu);
  std::printf("loops closed  %zu\n", m.loop_edges().size());
  const StereoRig& rig = m.rig();
  std::printf("cameras       %s, %d x %d, baseline %.3f m\n",
              rig.kind == StereoRig::Kind::kRectified ? "rectified pair" : "general pair",
              rig.left.width, rig.left.height, rig.baseline_m);
}

void print_maps(const map::Snapshot& m) {
  for (const map::MapInfo& info : m.maps()) {
    if (info.merged_into.valid()) {
      std::printf("map %-9u merged into map %u\n", info.id.value(), info.merged_into.value());
      continue;
    }
    double span_s = 0, first_s = 0;
    if (info.num_keyframes > 0) {
      const auto first = m.keyframe(info.first_keyframe).data->stamp_ns;
      span_s = to_seconds(m.keyframe(info.last_keyframe).data->stamp_ns - first);
      first_s = to_seconds(first);
    }
    std::printf("map %-9u %zu keyframes, %.1f s from stamp %.3f s, IMU %s\n", info.id.value(),
                info.num_keyframes, span_s, first_s,
                !info.imu_initialized       ? "not initialised"
                : info.imu_refinements >= 2 ? "initialised and refined"
                                            : "initialised");
  }
}

void print_file(const Arguments& a, const map::MapExtras& extras) {
  std::printf("file          %ju bytes\n", static_cast<std::uintmax_t>(fs::file_size(a.file)));
  for (const map::MapFileSection& s : map::map_file_sections(a.file))
    std::printf("  %-11s %12ju bytes, unpacked %12ju\n", s.name.c_str(),
                static_cast<std::uintmax_t>(s.file_bytes), static_cast<std::uintmax_t>(s.bytes));
  constexpr std::size_t kShown = 120;
  for (const auto& [name, text] : extras) {
    const bool plain =
        std::all_of(text.begin(), text.end(), [](char c) { return c >= 32 && c < 127; });
    std::printf("extra         %s, %zu bytes%s%s%s\n", name.c_str(), text.size(), plain ? ": " : "",
                plain ? text.substr(0, kShown).c_str() : "",
                plain && text.size() > kShown ? " ..." : "");
  }
}

int info(const Arguments& a) {
  const map::LoadedMap loaded = map::read_map_file(a.file);
  print_counts(loaded.map);
  print_maps(loaded.map);
  print_file(a, loaded.extras);
  return kExitOk;
}

int check(const Arguments& a) {
  const map::LoadedMap loaded = map::read_map_file(a.file);
  if (const auto fault = loaded.map.find_inconsistency()) {
    std::cerr << "fastloop: " << a.file << ": " << *fault << "\n";
    return kExitBadInput;
  }
  std::printf("%s: undamaged and consistent: %zu keyframes, %zu landmarks\n", a.file.c_str(),
              loaded.map.num_keyframes(), loaded.map.num_landmarks());
  return kExitOk;
}

std::string output(const Arguments& a, const char* extension) {
  return a.out.empty() ? fs::path(a.file).replace_extension(extension).string() : a.out;
}

int export_ply(const Arguments& a) {
  const map::LoadedMap loaded = map::read_map_file(a.file);
  const std::string out = output(a, ".ply");
  io::export_map_ply(out, loaded.map);
  std::printf("%s: %zu landmarks, %zu keyframes\n", out.c_str(), loaded.map.num_landmarks(),
              loaded.map.num_keyframes());
  return kExitOk;
}

int export_g2o(const Arguments& a) {
  const map::LoadedMap loaded = map::read_map_file(a.file);
  const std::string out = output(a, ".g2o");
  const io::G2oGraph graph = io::essential_g2o(loaded.map);
  io::write_g2o(out, graph);
  std::printf("%s: %zu vertices, %zu edges; solve with: fastloop posegraph %s\n", out.c_str(),
              graph.ids.size(), graph.problem.edges.size(), out.c_str());
  return kExitOk;
}

}  // namespace

void add_map_command(CLI::App& app, int& exit_code) {
  CLI::App* map = app.add_subcommand("map", "Look at a map file, check it, export it");
  map->require_subcommand(1);
  const auto add = [&](const char* name, const char* help, int (*run)(const Arguments&),
                       const char* out_help) {
    auto a = std::make_shared<Arguments>();
    CLI::App* command = map->add_subcommand(name, help);
    command->add_option("FILE", a->file, "Map file, of simulate-map or run --record-loops say")->required();
    if (out_help) command->add_option("--out", a->out, out_help);
    command->callback([a, run, &exit_code] { exit_code = run(*a); });
  };
  add("info", "What is in it: counts, maps, time spans, bytes of each part, extras", info, nullptr);
  add("check",
      "Whether it is undamaged and its parts agree with each other; exit code 2 and the reason "
      "when "
      "not",
      check, nullptr);
  add("export-ply",
      "Landmarks (grey) and keyframes (one colour a map) as a point cloud, for MeshLab", export_ply,
      "PLY file to write (default: FILE with the extension .ply)");
  add("export-g2o",
      "Essential graph: keyframe poses; spanning tree, 100 and more common landmarks, closed loops",
      export_g2o, "g2o file to write (default: FILE with the extension .g2o)");
}

}  // namespace fastloop::apps
