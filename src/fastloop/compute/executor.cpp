#include "fastloop/compute/executor.hpp"

#include <tbb/parallel_for.h>

#include "fastloop/compute/worker_team.hpp"

namespace fastloop {

Executor Executor::for_short_passes() const { return WorkerTeam::on_shift() ? *this : reference(); }

void Executor::for_ranges(std::size_t n, std::size_t grain,
                          const std::function<void(std::size_t, std::size_t)>& body) const {
  if (n == 0) return;
  if (sequential() || n <= grain || WorkerTeam::within_pass()) {
    body(0, n);
    return;
  }
  if (WorkerTeam* team = WorkerTeam::on_shift()) {
    team->run(n, grain, body);
    return;
  }
  tbb::parallel_for(tbb::blocked_range<std::size_t>(0, n, grain == 0 ? 1 : grain),
                    [&](const tbb::blocked_range<std::size_t>& r) { body(r.begin(), r.end()); });
}

}  // namespace fastloop
