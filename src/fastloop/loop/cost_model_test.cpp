#include "fastloop/loop/cost_model.hpp"

#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>

#include "fastloop/core/error.hpp"
#include "fastloop/loop/step_executors.hpp"

namespace fastloop::loop {
namespace {

namespace fs = std::filesystem;

class CostModelFile : public ::testing::Test {
 protected:
  CostModelFile() {
    for (int s = 0; s < kNumSteps; ++s)
      measured_.steps[static_cast<std::size_t>(s)] = {{1.5 + s, 20}, {70.25, 0.125 * (s + 1)}};
  }
  ~CostModelFile() override { fs::remove_all(folder_); }

  CostModel load(std::string* source = nullptr) const {
    return load_cost_model(file_, machine_, source);
  }
  std::string text() const {
    std::ifstream in(file_);
    return {std::istreambuf_iterator<char>(in), {}};
  }
  void write(const std::string& text) const {
    fs::create_directories(file_.parent_path());
    std::ofstream(file_) << text;
  }

  const fs::path folder_ =
      fs::temp_directory_path() /
      ("fastloop_cost_model_" +
       std::string(::testing::UnitTest::GetInstance()->current_test_info()->name()));
  const fs::path file_ = folder_ / "a" / "cost_model.json";
  const CostModelMachine machine_{"a CPU", "a GPU", 8};
  CostModel measured_;
};

TEST_F(CostModelFile, ComesBackAsItWasSaved) {
  save_cost_model(file_, measured_, machine_);
  std::string source;
  EXPECT_EQ(load(&source), measured_);
  EXPECT_EQ(source, file_.string());
}

TEST_F(CostModelFile, WithoutAFileDefaults) {
  std::string source;
  EXPECT_EQ(load(&source), CostModel::defaults(8));
  EXPECT_EQ(source, "defaults");
  EXPECT_EQ(load_cost_model({}, machine_), CostModel::defaults(8));
}

TEST_F(CostModelFile, DamagedOnesGiveDefaults) {
  save_cost_model(file_, measured_, machine_);
  const std::string good = text();
  const auto with = [&](const std::string& from, const std::string& to) {
    std::string changed = good;
    const auto at = changed.find(from);
    EXPECT_NE(at, changed.npos) << from;
    return changed.replace(at, from.size(), to);
  };
  for (const std::string& bad :
       {std::string(), std::string("{}"), std::string("[1, 2]"), good.substr(0, good.size() / 2),
        with("\"version\": 1", "\"version\": 2"), with("\"fixed_us\": 1.5", "\"fixed_us\": -1.5"),
        with("\"fixed_us\": 1.5", "\"fixed_us\": \"1.5\""), with("1.5", "1e300"),
        with("\"projection\"", "\"projections\"")}) {
    write(bad);
    std::string source;
    EXPECT_EQ(load(&source), CostModel::defaults(8)) << bad;
    EXPECT_EQ(source, "defaults");
  }
}

TEST_F(CostModelFile, OfAnotherMachineGivesDefaults) {
  save_cost_model(file_, measured_, machine_);
  for (const CostModelMachine& other :
       {CostModelMachine{"another CPU", "a GPU", 8}, CostModelMachine{"a CPU", "another GPU", 8},
        CostModelMachine{"a CPU", "a GPU", 4}})
    EXPECT_EQ(load_cost_model(file_, other), CostModel::defaults(other.threads));
}

TEST_F(CostModelFile, ThatCannotBeWrittenIsAnError) {
  write("a file where the folder should be");
  EXPECT_THROW(save_cost_model(file_ / "x.json", measured_, machine_), InputError);
}

TEST_F(CostModelFile, LiesInTheCacheFolder) {
  const auto keep = [](const char* name) {
    const char* value = std::getenv(name);
    return value ? std::string(value) : std::string();
  };
  const std::string cache = keep("XDG_CACHE_HOME"), home = keep("HOME");
  setenv("XDG_CACHE_HOME", "/x", 1);
  EXPECT_EQ(cost_model_file(), "/x/fastloop/cost_model.json");
  unsetenv("XDG_CACHE_HOME");
  setenv("HOME", "/h", 1);
  EXPECT_EQ(cost_model_file(), "/h/.cache/fastloop/cost_model.json");
  unsetenv("HOME");
  EXPECT_TRUE(cost_model_file().empty());
  if (!cache.empty()) setenv("XDG_CACHE_HOME", cache.c_str(), 1);
  if (!home.empty()) setenv("HOME", home.c_str(), 1);
}

TEST(CostModel, LittleWorkStaysOnTheCpuAndMuchGoesToTheDevice) {
  for (const int threads : {1, 2, 16}) {
    const CostModel m = CostModel::defaults(threads);
    for (int s = 0; s < kNumSteps; ++s) {
      EXPECT_FALSE(m.device_wins(static_cast<Step>(s), 0)) << to_string(static_cast<Step>(s));
      EXPECT_TRUE(m.device_wins(static_cast<Step>(s), 1e9)) << to_string(static_cast<Step>(s));
    }
  }
  CostModel m;
  m.of(Step::kProjection) = {{10, 5}, {50, 1}};
  // 1.2 (50 + 0.001 w) < 10 + 0.005 w from w = 13,158 on.
  EXPECT_FALSE(m.device_wins(Step::kProjection, 13'157));
  EXPECT_TRUE(m.device_wins(Step::kProjection, 13'159));
}

TEST(StepExecutors, ChooseByWorkOnlyWhereAsked) {
  CostModel m;
  for (auto& costs : m.steps) costs = {{0, 1}, {100, 0}};
  const Executor host = Executor::cpu(), other = Executor::reference();  // stands for a device
  const StepExecutors choosing(host, other, m);
  EXPECT_TRUE(choosing.choosing());
  EXPECT_EQ(choosing.of(Step::kSimilarity, 1e5).kind(), host.kind());
  EXPECT_EQ(choosing.of(Step::kSimilarity, 2e5).kind(), other.kind());
  EXPECT_EQ(choosing.host().kind(), host.kind());
  const StepExecutors fixed(other);
  EXPECT_FALSE(fixed.choosing());
  EXPECT_TRUE(fixed.reference());
  for (const double work : {0.0, 1e12})
    EXPECT_EQ(fixed.of(Step::kPoseGraph, work).kind(), other.kind());
}

}  // namespace
}  // namespace fastloop::loop
