#include "fastloop/map/cow_vector.hpp"

#include <gtest/gtest.h>

#include <memory>
#include <mutex>
#include <random>
#include <thread>
#include <vector>

namespace fastloop {
namespace {

using Vector = CowVector<std::vector<int>, 4>;

TEST(CowVector, CopiesKeepTheirContentsWhateverIsWrittenLater) {
  std::mt19937 rng(1);
  Vector owner;
  std::vector<std::vector<int>> expected;
  std::vector<std::pair<Vector, std::vector<std::vector<int>>>> copies;
  for (int step = 0; step < 4000; ++step) {
    const int value = static_cast<int>(rng() % 1000);
    switch (expected.empty() ? 0 : rng() % 8) {
      case 0:
      case 1:
        owner.push_back({value});
        expected.push_back({value});
        break;
      case 2:
        copies.emplace_back(owner, expected);
        if (copies.size() > 10)
          copies.erase(copies.begin() + static_cast<std::ptrdiff_t>(rng() % copies.size()));
        break;
      default: {
        const std::size_t i = rng() % expected.size();
        owner.mutate(i).push_back(value);
        expected[i].push_back(value);
      }
    }
  }
  copies.emplace_back(owner, expected);
  for (const auto& [copy, contents] : copies) {
    ASSERT_EQ(copy.size(), contents.size());
    for (std::size_t i = 0; i < contents.size(); ++i) ASSERT_EQ(copy[i], contents[i]);
  }
}

TEST(CowVector, ClonesAChunkOnlyWhileItIsShared) {
  CowVector<int, 4> a;
  for (int i = 0; i < 8; ++i) a.push_back(i);
  const int* alone = &a[5];
  a.mutate(5) = 50;
  EXPECT_EQ(&a[5], alone);
  {
    const CowVector<int, 4> copy = a;
    EXPECT_EQ(&copy[1], &a[1]);
    a.mutate(5) = 51;
    EXPECT_NE(&a[5], alone);
    EXPECT_EQ(copy[5], 50);
    EXPECT_EQ(&copy[1], &a[1]) << "an untouched chunk must stay shared";
  }
  const int* again = &a[5];
  a.mutate(5) = 52;
  EXPECT_EQ(&a[5], again);
}

/// The writer keeps the sum of each published copy at zero; readers would see a torn copy. Run
/// under the thread sanitiser this also shows that a chunk is written in place only after its last
/// reader is gone.
TEST(CowVector, ReadersOfCopiesAndOneWriterDoNotMeet) {
  using Numbers = CowVector<long, 8>;
  std::mutex mutex;
  std::shared_ptr<const Numbers> published;
  bool done = false;
  Numbers owner;
  for (int i = 0; i < 64; ++i) owner.push_back(0);
  published = std::make_shared<const Numbers>(owner);

  const auto read = [&](std::size_t* checked, long* torn) {
    for (bool last = false; !last;) {
      std::shared_ptr<const Numbers> mine;
      {
        const std::lock_guard lock(mutex);
        last = done;
        mine = published;
      }
      const Numbers copy = *mine;  // copies of copies share chunks as well
      mine.reset();
      long sum = 0;
      for (std::size_t i = 0; i < copy.size(); ++i) sum += copy[i];
      *torn += sum != 0;
      ++*checked;
    }
  };
  std::size_t checked[2] = {0, 0};
  long torn[2] = {0, 0};
  std::thread first(read, &checked[0], &torn[0]), second(read, &checked[1], &torn[1]);
  std::mt19937 rng(2);
  for (int round = 0; round < 3000; ++round) {
    for (int k = 0; k < 4; ++k) {
      const long change = static_cast<long>(rng() % 100);
      owner.mutate(rng() % owner.size()) += change;
      owner.mutate(rng() % owner.size()) -= change;
    }
    if (round % 50 == 0) owner.push_back(0);
    auto next = std::make_shared<const Numbers>(owner);
    const std::lock_guard lock(mutex);
    published = std::move(next);
  }
  {
    const std::lock_guard lock(mutex);
    done = true;
  }
  first.join();
  second.join();
  EXPECT_EQ(torn[0] + torn[1], 0);
  EXPECT_GE(checked[0] * checked[1], 1u);
  long sum = 0;
  for (std::size_t i = 0; i < owner.size(); ++i) sum += owner[i];
  EXPECT_EQ(sum, 0);
}

}  // namespace
}  // namespace fastloop
