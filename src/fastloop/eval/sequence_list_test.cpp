#include "fastloop/eval/sequence_list.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <fstream>

#include "fastloop/core/error.hpp"
#include "fastloop/io/test_support.hpp"

namespace fastloop::eval {
namespace {

namespace fs = std::filesystem;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

constexpr const char* kList = R"(sequences:
  - name: A
    group: first
    paper: true
    sources:
      - {kind: real, folders: [A_real, set/A_real]}
      - {kind: half-real, folders: [half/a]}
  - name: B
    group: second
    mode: stereo
    sources: [{kind: simulated, folders: [sim-b], simulate: {world: room, seconds: 5}}]
)";

TEST(SequenceList, PrefersRealImages) {
  const auto rows = parse_sequences(kList, "list");
  ASSERT_EQ(rows.size(), 2u);
  EXPECT_TRUE(rows[0].paper);
  EXPECT_FALSE(rows[1].paper);
  EXPECT_EQ(rows[0].mode, "auto");
  EXPECT_EQ(rows[1].mode, "stereo");
  const io::TemporaryFolder folder;
  const std::vector<fs::path> roots{folder.path() / "x", folder.path() / "y"};
  EXPECT_FALSE(locate(rows[0], roots));
  fs::create_directories(roots[0] / "half/a");
  EXPECT_EQ(locate(rows[0], roots)->kind, SequenceKind::kHalfReal);
  fs::create_directories(roots[1] / "set/A_real");
  const auto real = locate(rows[0], roots);
  EXPECT_EQ(real->kind, SequenceKind::kReal);
  EXPECT_EQ(real->folder, roots[1] / "set/A_real");
}

TEST(SequenceList, SimulatesWhatIsNotThere) {
  const auto rows = parse_sequences(kList, "list");
  const io::TemporaryFolder folder;
  const std::vector<fs::path> roots{folder.path()};
  const auto missing = locate(rows[1], roots);
  ASSERT_TRUE(missing && missing->simulate);
  EXPECT_TRUE(missing->folder.empty());
  EXPECT_EQ(missing->simulate->world, "room");
  EXPECT_DOUBLE_EQ(missing->simulate->seconds, 5);
  fs::create_directories(folder.path() / "sim-b");
  EXPECT_EQ(locate(rows[1], roots)->folder, folder.path() / "sim-b");
}

TEST(SequenceList, NamesFoldersGivenDirectly) {
  const auto rows = parse_sequences(kList, "list");
  EXPECT_EQ(classify("/data/half/a/", rows).row.name, "A");
  EXPECT_EQ(classify("/data/half/a", rows).kind, SequenceKind::kHalfReal);
  EXPECT_EQ(classify("/data/set/A_real", rows).kind, SequenceKind::kReal);
  // Half a name is no name.
  const NamedFolder other = classify("/data/other/a", rows);
  EXPECT_EQ(other.row.name, "a");
  EXPECT_EQ(other.kind, SequenceKind::kUnknown);
}

TEST(SequenceList, RecognisesTheSimulatorsMarker) {
  const io::TemporaryFolder folder;
  folder.write("mine/simulation.txt", "world room\nmotion synthetic\n");
  folder.write("flown/simulation.txt", "world room\nmotion recorded\n");
  EXPECT_EQ(classify(folder.path() / "flown", {}).kind, SequenceKind::kHalfReal);
  EXPECT_EQ(classify(folder.path() / "mine", {}).kind, SequenceKind::kSimulated);
}

TEST(SequenceList, BadListsAreRefusedWithTheirPlace) {
  const auto message = [](const std::string& text) -> std::string {
    try {
      parse_sequences(text, "list.yaml");
    } catch (const InputError& e) {
      return e.what();
    }
    return "";
  };
  EXPECT_THAT(message("sequences: [{name: A, group: g, sources: [{kind: fake, folders: [a]}]}]"),
              HasSubstr("real, half-real or simulated"));
  EXPECT_THAT(message("sequences: [{name: A, group: g, sources: [], colour: red}]"),
              HasSubstr("colour"));
  EXPECT_THAT(message("sequences:\n- {name: A, group: g, sources: []}\n- {name: A, group: g, "
                      "sources: []}\n"),
              HasSubstr("twice"));
  EXPECT_THAT(message("sequences: [{name: A, sources: []}]"), HasSubstr("group"));
}

/// The list that travels with the program.
TEST(SequenceList, ShippedListHasTheRowsOfThePaper) {
  std::ifstream in(FASTLOOP_SEQUENCES_YAML);
  const std::string text{std::istreambuf_iterator<char>(in), {}};
  std::vector<std::string> paper;
  for (const SequenceRow& row : parse_sequences(text, "sequences.yaml"))
    if (row.paper) paper.push_back(row.name);
  EXPECT_THAT(paper, ElementsAre("V102", "V103", "V202", "V203", "room3", "room4", "corridor1",
                                 "magistrale1", "magistrale2", "outdoors5", "outdoors7"));
}

}  // namespace
}  // namespace fastloop::eval
