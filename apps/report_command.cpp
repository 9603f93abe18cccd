#include "commands.hpp"

namespace fastloop::apps {
void add_report_command(CLI::App&, int&) {}
}  // namespace fastloop::apps
