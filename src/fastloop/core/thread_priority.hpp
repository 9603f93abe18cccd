#pragma once

namespace fastloop {

/// Lets the calling thread give way to others where cores are short: for work that nothing waits
/// for. Does nothing where the system does not offer it.
void lower_thread_priority();

}  // namespace fastloop
