#include "fastloop/compute/worker_team.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>
#include <set>
#include <stdexcept>

#include "fastloop/compute/executor.hpp"

namespace fastloop {
namespace {

/// Ranges as a pass gave them, sorted.
std::vector<std::pair<std::size_t, std::size_t>> ranges_of(WorkerTeam& team, std::size_t n,
                                                           std::size_t grain) {
  std::mutex mutex;
  std::vector<std::pair<std::size_t, std::size_t>> ranges;
  team.run(n, grain, [&](std::size_t begin, std::size_t end) {
    const std::lock_guard lock(mutex);
    ranges.emplace_back(begin, end);
  });
  std::sort(ranges.begin(), ranges.end());
  return ranges;
}

TEST(WorkerTeam, EveryIndexIsInOneRange) {
  WorkerTeam team(3);
  const WorkerTeam::Shift shift(team);
  for (const std::size_t n : {0u, 1u, 15u, 16u, 17u, 1000u})
    for (const std::size_t grain : {0u, 1u, 16u, 2000u}) {
      std::size_t next = 0;
      for (const auto& [begin, end] : ranges_of(team, n, grain)) {
        EXPECT_EQ(begin, next);
        EXPECT_LE(end - begin, std::max<std::size_t>(1, grain));
        next = end;
      }
      EXPECT_EQ(next, n);
    }
}

TEST(WorkerTeam, HelpersTakePart) {
  WorkerTeam team(1);
  const WorkerTeam::Shift shift(team);
  // Two ranges that wait for each other: without a helper the first would wait for ever.
  std::atomic<int> arrived = 0;
  std::mutex mutex;
  std::set<std::thread::id> threads;
  team.run(2, 1, [&](std::size_t, std::size_t) {
    {
      const std::lock_guard lock(mutex);
      threads.insert(std::this_thread::get_id());
    }
    ++arrived;
    while (arrived < 2) std::this_thread::yield();
  });
  EXPECT_EQ(threads.size(), 2u);
  EXPECT_TRUE(threads.contains(std::this_thread::get_id()));
}

TEST(WorkerTeam, ManyShortPassesAreAllDone) {
  WorkerTeam team(3);
  std::vector<int> values(256, 0);
  for (int round = 0; round < 20; ++round) {
    const WorkerTeam::Shift shift(team);
    for (int pass = 0; pass < 100; ++pass)
      team.run(values.size(), 8, [&](std::size_t begin, std::size_t end) {
        for (; begin < end; ++begin) ++values[begin];
      });
  }
  EXPECT_EQ(values, std::vector<int>(256, 2000));
}

TEST(WorkerTeam, TheFirstExceptionReachesTheCallerAndTheTeamGoesOn) {
  WorkerTeam team(2);
  const WorkerTeam::Shift shift(team);
  for (int i = 0; i < 50; ++i) {
    EXPECT_THROW(team.run(100, 1, [](std::size_t begin, std::size_t) {
      if (begin >= 10) throw std::runtime_error("x");
    }), std::runtime_error);
    EXPECT_EQ(ranges_of(team, 10, 1).size(), 10u);
  }
}

TEST(WorkerTeam, ExecutorsUseItDuringAShiftOnly) {
  WorkerTeam team(1);
  EXPECT_EQ(WorkerTeam::on_shift(), nullptr);
  EXPECT_TRUE(Executor::cpu().for_short_passes().sequential());
  {
    const WorkerTeam::Shift shift(team);
    EXPECT_EQ(WorkerTeam::on_shift(), &team);
    EXPECT_FALSE(Executor::cpu().for_short_passes().sequential());
    {
      const WorkerTeam::Rest rest;
      EXPECT_EQ(WorkerTeam::on_shift(), nullptr);
    }
    EXPECT_EQ(WorkerTeam::on_shift(), &team);
    std::atomic<std::size_t> sum = 0;
    Executor::cpu().for_ranges(1000, 10, [&](std::size_t begin, std::size_t end) {
      for (; begin < end; ++begin) sum += begin;
    });
    EXPECT_EQ(sum, 499500u);
  }
  EXPECT_EQ(WorkerTeam::on_shift(), nullptr);
}

TEST(WorkerTeam, PassesWithinPassesAreNotDividedAgain) {
  WorkerTeam team(2);
  const WorkerTeam::Shift shift(team);
  std::atomic<int> inner = 0;
  Executor::cpu().for_ranges(8, 1, [&](std::size_t, std::size_t) {
    Executor::cpu().for_ranges(100, 1, [&](std::size_t begin, std::size_t end) {
      EXPECT_EQ(begin, 0u);
      EXPECT_EQ(end, 100u);
      ++inner;
    });
  });
  EXPECT_EQ(inner, 8);
}

TEST(WorkerTeam, OneThreadAtATimeHasTheHelpers) {
  WorkerTeam team(1);
  const WorkerTeam::Shift shift(team);
  {
    const WorkerTeam::Shift again(team);  // changes nothing, its end neither
  }
  EXPECT_EQ(WorkerTeam::on_shift(), &team);
  std::thread([&] {
    const WorkerTeam::Shift other(team);
    EXPECT_EQ(WorkerTeam::on_shift(), nullptr);
  }).join();
  EXPECT_EQ(ranges_of(team, 10, 1).size(), 10u);
}

TEST(WorkerTeam, WithoutHelpersThereIsNoShift) {
  WorkerTeam team(0);
  const WorkerTeam::Shift shift(team);
  EXPECT_EQ(WorkerTeam::on_shift(), nullptr);
}

}  // namespace
}  // namespace fastloop
