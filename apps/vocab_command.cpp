#include <algorithm>
#include <filesystem>
#include <iostream>
#include <opencv2/imgcodecs.hpp>
#include <set>

#include "commands.hpp"
#include "fastloop/core/error.hpp"
#include "fastloop/core/time.hpp"
#include "fastloop/features/orb_extractor.hpp"
#include "fastloop/place/vocabulary_io.hpp"
#include "fastloop/place/vocabulary_training.hpp"

namespace fastloop::apps {
namespace {

namespace fs = std::filesystem;

struct TrainArguments {
  std::vector<std::string> folders;
  std::string out;
  int every = 1;
  OrbOptions orb;
  place::TrainingOptions training;
};

/// Image files below a folder in the order of their paths, every n-th of them.
std::vector<fs::path> images_below(const std::string& folder, int every) {
  if (!fs::exists(folder)) throw InputError({folder, 0, ""}, "no such folder");
  std::vector<fs::path> all;
  const std::set<std::string> kinds{".png", ".jpg", ".jpeg", ".pgm"};
  if (fs::is_regular_file(folder)) all.push_back(folder);
  if (fs::is_directory(folder))
    for (const auto& entry : fs::recursive_directory_iterator(folder))
      if (entry.is_regular_file() && kinds.contains(entry.path().extension().string()))
        all.push_back(entry.path());
  std::sort(all.begin(), all.end());
  std::vector<fs::path> chosen;
  for (std::size_t i = 0; i < all.size(); i += static_cast<std::size_t>(every))
    chosen.push_back(all[i]);
  if (chosen.empty()) throw InputError({folder, 0, ""}, "no images", "*.png, *.jpg or *.pgm");
  return chosen;
}

ImageU8 read_grey(const fs::path& file) {
  const cv::Mat read = cv::imread(file.string(), cv::IMREAD_GRAYSCALE);
  if (read.empty()) throw InputError({file.string(), 0, ""}, "cannot read the image");
  ImageU8 image(read.cols, read.rows);
  for (int y = 0; y < read.rows; ++y) std::copy_n(read.ptr(y), read.cols, image.row(y));
  return image;
}

std::vector<std::vector<Descriptor>> extract_all(const std::vector<fs::path>& files,
                                                 const OrbOptions& options) {
  std::vector<std::vector<Descriptor>> descriptors(files.size());
  Executor::cpu().for_ranges(files.size(), 8, [&](std::size_t begin, std::size_t end) {
    OrbExtractor extractor(options);
    for (std::size_t i = begin; i < end; ++i)
      descriptors[i] = extractor.extract(read_grey(files[i])).descriptors;
  });
  return descriptors;
}

void print(const place::VocabularyTree& tree) {
  std::size_t words = 0;
  for (std::size_t n = 1; n < tree.size(); ++n) words += tree.is_leaf(n);
  std::cout << "branching " << tree.branching << "\nlevels    " << tree.levels << "\nnodes     "
            << tree.size() << "\nwords     " << words << "\n";
}

void save(const place::VocabularyTree& tree, const std::string& file) {
  fs::path(file).extension() == ".txt" ? place::save_vocabulary_text(tree, file)
                                       : place::save_vocabulary(tree, file);
  std::cout << "file      " << file << " (" << fs::file_size(file) << " bytes)\n";
}

void train(const TrainArguments& a) {
  a.orb.validate();
  std::vector<fs::path> files;
  for (const std::string& folder : a.folders)
    for (fs::path& file : images_below(folder, a.every)) files.push_back(std::move(file));
  Stopwatch watch;
  const auto descriptors = extract_all(files, a.orb);
  std::size_t total = 0;
  for (const auto& image : descriptors) total += image.size();
  std::cout << "images    " << files.size() << "\nfeatures  " << total << " ("
            << watch.elapsed_ms() / 1000 << " s)" << std::endl;
  watch.restart();
  const auto tree = place::train_vocabulary(Executor::cpu(), descriptors, a.training);
  std::cout << "training  " << watch.elapsed_ms() / 1000 << " s\n";
  print(tree);
  save(tree, a.out);
}

void add_train(CLI::App& vocab, int& exit_code) {
  auto a = std::make_shared<TrainArguments>();
  CLI::App* app = vocab.add_subcommand("train", "Train a vocabulary on images");
  app->add_option("FOLDER", a->folders,
                  "Folders searched for *.png, *.jpg and *.pgm, or image files")
      ->required();
  app->add_option("--out", a->out, "Vocabulary to write; *.txt for DBoW2's text format")
      ->required();
  app->add_option("--every", a->every, "Use every n-th image of a folder")
      ->check(CLI::PositiveNumber);
  app->add_option("--features", a->orb.num_features, "Features an image")->capture_default_str();
  app->add_option("--branching", a->training.branching, "Children a node")->capture_default_str();
  app->add_option("--levels", a->training.levels, "Depth of the tree")->capture_default_str();
  app->add_option("--min-to-split", a->training.min_to_split,
                  "Fewer descriptors in a node make one word")
      ->capture_default_str();
  app->add_option("--seed", a->training.seed, "Of the random choices")->capture_default_str();
  app->callback([a, &exit_code] {
    train(*a);
    exit_code = kExitOk;
  });
}

void add_info(CLI::App& vocab, int& exit_code) {
  auto file = std::make_shared<std::string>();
  CLI::App* app = vocab.add_subcommand("info", "Size of a vocabulary, and whether it is intact");
  app->add_option("FILE", *file, "Vocabulary, binary or text")->required();
  app->callback([file, &exit_code] {
    Stopwatch watch;
    const place::Vocabulary vocabulary(place::load_any_vocabulary(*file));
    const double ms = watch.elapsed_ms();
    print(vocabulary.tree());
    std::cout << "loaded in " << ms << " ms\n";
    exit_code = kExitOk;
  });
}

void add_convert(CLI::App& vocab, int& exit_code) {
  auto files = std::make_shared<std::pair<std::string, std::string>>();
  CLI::App* app = vocab.add_subcommand(
      "convert", "Convert between DBoW2's text format (*.txt) and the binary format");
  app->add_option("IN", files->first, "Vocabulary, binary or text")->required();
  app->add_option("OUT", files->second, "Vocabulary to write; *.txt for the text format")
      ->required();
  app->callback([files, &exit_code] {
    const auto tree = place::load_any_vocabulary(files->first);
    print(tree);
    save(tree, files->second);
    exit_code = kExitOk;
  });
}

}  // namespace

void add_vocab_command(CLI::App& app, int& exit_code) {
  CLI::App* vocab = app.add_subcommand("vocab", "Vocabularies for place recognition");
  vocab->require_subcommand(1);
  add_train(*vocab, exit_code);
  add_info(*vocab, exit_code);
  add_convert(*vocab, exit_code);
}

}  // namespace fastloop::apps
