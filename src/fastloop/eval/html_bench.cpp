// Results of `fastloop bench` as sections of a page.
#include "fastloop/eval/html.hpp"
#include "fastloop/eval/replay_table.hpp"
#include "fastloop/eval/svg.hpp"

namespace fastloop::eval {
namespace {

using Rows = std::vector<std::vector<std::string>>;

std::string text_of(const Json& j) {
  return escaped(j.get<std::string>());
}

/// "12.3 ± 0.4 (5.2x)"; the mean says where it is from.
std::string time_cell(const std::string& key, const Json& s, const Json& speed_up) {
  std::string cell = "<span data-key=\"" + escaped(key) + ".mean\" data-value=\"" +
                     s.at("mean").dump() + "\">" + mean_and_sd(s) + "</span>";
  if (!speed_up.is_null()) cell += " (" + three_digits(speed_up.get<double>()) + "x)";
  return cell;
}

/// One line for each entry and back end: times by the columns of the paper.
Rows times_of(const Json& entries, const std::string& prefix, const char* speed_up_at) {
  Rows rows;
  std::size_t index = 0;
  for (const Json& entry : entries) {
    const std::string at = prefix + "." + std::to_string(index++);
    if (!entry.contains("backends")) continue;
    for (const auto& [backend, b] : entry.at("backends").items()) {
      if (b.is_null() || b.at("columns_ms").is_null()) continue;
      std::vector<std::string> cells{text_of(entry.at("name"))};
      cells.push_back(entry.contains("kind") ? text_of(entry.at("kind")) : entry.at("edges").dump());
      cells.push_back(backend);
      for (const PaperColumn& c : paper_columns()) {
        Json ratio;
        if (entry.contains(speed_up_at) && entry[speed_up_at].contains(backend)) {
          const Json& of = entry[speed_up_at][backend];
          const Json& list = of.contains("speed_up") ? of.at("speed_up") : of;
          if (list.contains(c.key)) ratio = list[c.key];
        }
        cells.push_back(time_cell(at + ".backends." + backend + ".columns_ms." + c.key,
                                  b.at("columns_ms")[c.key], ratio));
      }
      rows.push_back(cells);
    }
  }
  return rows;
}

std::vector<std::string> times_head(const std::string& first, const std::string& second) {
  std::vector<std::string> head{first, second, "back end"};
  for (const PaperColumn& c : paper_columns()) head.push_back(std::string(c.title) + " [ms]");
  return head;
}

void add_loops(HtmlPage& page, const Json& table, const std::string& prefix) {
  page.table(times_head("sequence", "images"),
             times_of(table.at("sequences"), prefix + ".sequences", "comparison"));
  std::vector<std::string> head{"sequence", "path"};
  for (const Json& backend : table.at("backends")) head.push_back("ATE " + text_of(backend) + " [m]");
  head.insert(head.end(), {"accuracy kept", "tracking around loops, p99 / worst [ms]", "memory"});
  Rows rows;
  std::size_t index = 0;
  for (const Json& s : table.at("sequences")) {
    const std::string at = prefix + ".sequences." + std::to_string(index++);
    if (s.contains("missing")) continue;
    std::vector<std::string> cells{text_of(s.at("name")),
                                   number_html(at + ".path_length_m", s.at("path_length_m"), 1, "m")};
    std::string kept = "-", tracking, memory;
    for (const auto& [backend, b] : s.at("backends").items()) {
      const std::string key = at + ".backends." + backend;
      cells.push_back(
          b.at("ate_m").is_null() ? "-" : number_html(key + ".ate_m.median", b.at("ate_m").at("median"), 4));
      const Json& t = b.at("tracking_around_loops_ms");
      if (!t.is_null())
        tracking += (tracking.empty() ? "" : ", ") +
                    number_html(key + ".tracking_around_loops_ms.p99", t.at("p99"), 1) + " / " +
                    number_html(key + ".tracking_around_loops_ms.worst", t.at("worst"), 1);
      memory += (memory.empty() ? "" : ", ") +
                number_html(key + ".host_peak_mib.max", b.at("host_peak_mib").at("max"), 0);
      if (const Json& device = b.at("device_peak_mib"); !device.is_null())
        memory += " + " + number_html(key + ".device_peak_mib.max", device.at("max"), 0);
    }
    if (s.contains("comparison")) {
      kept.clear();
      for (const auto& [backend, c] : s.at("comparison").items())
        kept += (kept.empty() ? "" : ", ") + std::string(!c.contains("accuracy_kept") ? "-"
                                                         : c["accuracy_kept"]         ? "yes"
                                                                                      : "NO");
    }
    cells.insert(cells.end(), {kept, tracking.empty() ? "-" : tracking, memory + "&nbsp;MiB"});
    rows.push_back(cells);
  }
  page.table(head, rows);
}

void add_replays(HtmlPage& page, const Json& table, const std::string& prefix) {
  page.table(times_head(table.at("kind") == "bench scale" ? "keyframes" : "loop", "edges"),
             times_of(table.at("cases"), prefix + ".cases", "speed_up"));
  if (table.at("kind") != "bench scale") return;
  page.begin_figures();
  for (std::size_t b = 1; b < table.at("backends").size(); ++b) {
    const std::string backend = table.at("backends")[b];
    const std::string base = table.at("backends").at(0);
    page.figure(speed_up_chart(table, ScaleAxis::kPoses, backend),
                "Speed-up of " + backend + " over " + base + " against the poses of the graph");
    page.figure(speed_up_chart(table, ScaleAxis::kEdges, backend), "The same against its edges");
  }
  page.figure(time_chart(table), "Whole loop closing against the size of the map");
  page.end_figures();
}

}  // namespace

void add_bench(HtmlPage& page, const Json& table, std::size_t index) {
  const std::string kind = table.at("kind"), prefix = "bench" + std::to_string(index);
  page.section(kind == "bench loops"    ? "Loop closing on sequences"
               : kind == "bench replay" ? "Recorded loops closed again"
                                        : "Loop closing against the size of the map");
  const Json& m = table.at("machine");
  page.html("<p>Mean ± standard deviation in ms; in brackets the speed-up against " +
            text_of(table.at("backends").at(0)) + " (ratio of medians). " + text_of(table.at("date")) +
            ", commit " + text_of(table.at("commit")) + ", " + text_of(m.at("cpu")) + ", " +
            m.at("cores").dump() + " cores, " + table.at("runs").dump() + " runs after " +
            table.at("warm_up").dump() + " unmeasured.<br><code>" + text_of(table.at("command")) +
            "</code></p>\n");
  if (kind == "bench loops")
    add_loops(page, table, prefix);
  else
    add_replays(page, table, prefix);
}

}  // namespace fastloop::eval
