#include "fastloop/core/thread_priority.hpp"

#if defined(__linux__)
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace fastloop {

void lower_thread_priority() {
#if defined(__linux__)
  // On Linux a thread has a nice value of its own, under its thread id.
  setpriority(PRIO_PROCESS, static_cast<id_t>(syscall(SYS_gettid)), 10);
#endif
}

}  // namespace fastloop
