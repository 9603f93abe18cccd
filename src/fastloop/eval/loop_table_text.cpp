// The table of loop closing as Markdown and CSV.
#include <cmath>
#include <cstdio>

#include "fastloop/eval/loop_table.hpp"

namespace fastloop::eval {
namespace {

std::string fixed(double value, int decimals) {
  char text[60];
  std::snprintf(text, sizeof text, "%.*f", decimals, value);
  return text;
}

std::string text_of(const Json& j) {
  return j.get<std::string>();
}

/// Collects the rows of a Markdown table.
class Rows {
 public:
  explicit Rows(const std::vector<std::string>& head) {
    add(head);
    add(std::vector<std::string>(head.size(), "---"));
  }
  void add(const std::vector<std::string>& cells) {
    for (const std::string& cell : cells) text_ += "| " + cell + " ";
    text_ += "|\n";
  }
  const std::string& text() const { return text_; }

 private:
  std::string text_;
};

/// Applies to each row that has numbers.
template <class Use>
void for_each_row(const Json& table, const Use& use) {
  for (const Json& row : table["sequences"])
    if (!row.contains("missing")) use(row);
}

std::string times_table(const Json& table) {
  std::vector<std::string> head{"sequence", "images", "back end", "loops"};
  for (const PaperColumn& c : paper_columns()) head.push_back(c.title);
  Rows rows(head);
  for_each_row(table, [&](const Json& row) {
    for (const auto& [backend, b] : row["backends"].items()) {
      std::vector<std::string> cells{text_of(row["name"]), text_of(row["kind"]), backend,
                                     std::to_string(b["loops"].get<int>())};
      for (const PaperColumn& c : paper_columns()) {
        if (b["columns_ms"].is_null()) {
          cells.push_back("-");
          continue;
        }
        std::string cell = mean_and_sd(b["columns_ms"][c.key]);
        if (row.contains("comparison") && row["comparison"].contains(backend) &&
            row["comparison"][backend]["speed_up"].contains(c.key))
          cell += " (" + three_digits(row["comparison"][backend]["speed_up"][c.key].get<double>()) +
                  "x)";
        cells.push_back(cell);
      }
      rows.add(cells);
    }
  });
  return rows.text();
}

std::string accuracy_table(const Json& table) {
  std::vector<std::string> head{"sequence", "images", "ground truth", "path", "coverage"};
  for (const Json& backend : table["backends"]) head.push_back("ATE " + text_of(backend));
  for (std::size_t b = 1; b < table["backends"].size(); ++b)
    head.push_back("kept by " + text_of(table["backends"][b]));
  Rows rows(head);
  for_each_row(table, [&](const Json& row) {
    const Json& first = row["backends"].front();
    const bool truth = !row["ground_truth"].is_null();
    std::vector<std::string> cells{text_of(row["name"]), text_of(row["kind"]),
                                   truth ? text_of(row["ground_truth"]) : "none"};
    cells.push_back(truth ? fixed(row["path_length_m"], 1) + " m" : "-");
    cells.push_back(truth ? fixed(first["coverage_percent"], 1) + " %" : "-");
    for (const auto& [backend, b] : row["backends"].items())
      cells.push_back(b["ate_m"].is_null() ? "-" : fixed(b["ate_m"]["median"], 4) + " m");
    if (row.contains("comparison"))
      for (const auto& [backend, c] : row["comparison"].items())
        cells.push_back(!c.contains("accuracy_kept") ? "-" : c["accuracy_kept"] ? "yes" : "NO");
    rows.add(cells);
  });
  return rows.text();
}

std::string three_times(const Json& t) {
  if (t.is_null()) return "-";
  return fixed(t["p50"], 1) + " / " + fixed(t["p99"], 1) + " / " + fixed(t["worst"], 1);
}

std::string rest_table(const Json& table) {
  Rows rows({"sequence", "back end", "frames", "keyframes", "loops", "merges", "merge ms",
             "tracking ms around loops: p50 / p99 / worst", "tracking ms: p50 / p99 / worst",
             "host memory", "device memory", "transfers"});
  for_each_row(table, [&](const Json& row) {
    for (const auto& [backend, b] : row["backends"].items()) {
      const auto mib = [&](const char* key) {
        return b[key].is_null() ? std::string("-") : fixed(b[key]["max"], 0) + " MiB";
      };
      rows.add({text_of(row["name"]), backend, std::to_string(row["frames"].get<int>()),
                std::to_string(b["keyframes"].get<int>()), std::to_string(b["loops"].get<int>()),
                std::to_string(b["merges"].get<int>()),
                b["merge_ms"].is_null() ? "-" : mean_and_sd(b["merge_ms"]),
                three_times(b["tracking_around_loops_ms"]), three_times(b["tracking_ms"]),
                mib("host_peak_mib"), mib("device_peak_mib"), mib("device_transfers_mib")});
    }
  });
  return rows.text();
}

/// What the table says, back end by back end.
std::string verdicts(const Json& table) {
  std::string text;
  for (std::size_t b = 1; b < table["backends"].size(); ++b) {
    const std::string name = text_of(table["backends"][b]);
    int rows = 0, with_truth = 0, kept = 0, with_loops = 0, faster = 0, same = 0;
    double log_sum = 0;
    for_each_row(table, [&](const Json& row) {
      const Json& c = row["comparison"][name];
      ++rows;
      same += c["same_loops"].get<bool>();
      if (c.contains("accuracy_kept")) {
        ++with_truth;
        kept += c["accuracy_kept"].get<bool>();
      }
      if (!c["speed_up"].contains("total")) return;
      const double ratio = c["speed_up"]["total"];
      ++with_loops;
      faster += ratio > 1;
      log_sum += std::log(ratio);
    });
    text += "- `" + name + "` against `" + text_of(table["backends"][0]) +
            "`: the same number of loops on " + std::to_string(same) + " of " +
            std::to_string(rows) + " rows; accuracy kept on " + std::to_string(kept) + " of " +
            std::to_string(with_truth);
    if (with_loops)
      text += "; total loop closing faster on " + std::to_string(faster) + " of " +
              std::to_string(with_loops) + " rows with loops, " +
              three_digits(std::exp(log_sum / with_loops)) + " times (geometric mean)";
    text += ".\n";
  }
  return text;
}

std::string remarks(const Json& table) {
  std::string missing, text;
  for (const Json& row : table["sequences"]) {
    if (row.contains("missing"))
      missing += (missing.empty() ? "" : ", ") + text_of(row["name"]);
    else
      for (const Json& w : row["warnings"])
        text += "- " + text_of(row["name"]) + ": " + text_of(w) + "\n";
  }
  if (!missing.empty()) text += "- Not at hand, so without a row: " + missing + ".\n";
  return text;
}

}  // namespace

std::string provenance_markdown(const Json& table) {
  const Json& m = table["machine"];
  return "- date " + text_of(table["date"]) + ", commit `" + text_of(table["commit"]) +
         "`, built " + text_of(m["build"]) + " with " + text_of(m["compiler"]) + "\n- machine " +
         text_of(m["cpu"]) + ", " + std::to_string(m["cores"].get<int>()) + " cores, " +
         fixed(m["memory_gib"], 1) + " GiB\n- command `" + text_of(table["command"]) + "`\n- " +
         std::to_string(table["runs"].get<int>()) + " runs of each back end in turn, after " +
         std::to_string(table["warm_up"].get<int>()) + " unmeasured\n";
}

std::string loop_table_markdown(const Json& table) {
  std::string text = provenance_markdown(table) + "\n" + verdicts(table);
  text +=
      "\nTimes of a loop in ms, mean ± standard deviation over the loops of all runs; in brackets "
      "the "
      "speed-up against the first back end (ratio of medians).\nTotal = region detection + loop "
      "correction; loop "
      "correction = loop fusion + graph optimisation + what is left.\n\n" +
      times_table(table);
  text +=
      "\nATE: RMSE after SE3 alignment of all tracked frames, median over the runs. Kept: worse by "
      "at most 5 % or 2 mm.\n\n" +
      accuracy_table(table);
  text +=
      "\nTracking around loops: frames within 2 s of a correction. Memory: peak of the whole "
      "process.\n\n" +
      rest_table(table);
  const std::string notes = remarks(table);
  if (!notes.empty()) text += "\nRemarks\n\n" + notes;
  return text;
}

std::string loop_table_csv(const Json& table) {
  std::string text = "sequence,group,kind,backend,runs,frames,keyframes,loops,merges";
  for (const PaperColumn& c : paper_columns())
    text += std::string(",") + c.key + "_mean_ms," + c.key + "_sd_ms," + c.key + "_median_ms";
  text +=
      ",ate_median_m,coverage_percent,track_loop_p50_ms,track_loop_p99_ms,track_loop_worst_ms,"
      "merge_mean_ms,host_peak_mib,device_peak_mib,device_transfers_mib\n";
  const auto number = [](const Json& j) { return j.is_null() ? std::string() : j.dump(); };
  const auto part = [&](const Json& j, const char* key) {
    return j.is_null() ? std::string() : number(j[key]);
  };
  for_each_row(table, [&](const Json& row) {
    for (const auto& [backend, b] : row["backends"].items()) {
      text += text_of(row["name"]) + "," + text_of(row["group"]) + "," + text_of(row["kind"]) +
              "," + backend + "," + number(b["runs"]) + "," + number(row["frames"]) + "," +
              number(b["keyframes"]) + "," + number(b["loops"]) + "," + number(b["merges"]);
      for (const PaperColumn& c : paper_columns())
        for (const char* key : {"mean", "sd", "median"})
          text += "," + (b["columns_ms"].is_null() ? "" : number(b["columns_ms"][c.key][key]));
      text += "," + part(b["ate_m"], "median") + "," + number(b["coverage_percent"]);
      for (const char* key : {"p50", "p99", "worst"})
        text += "," + part(b["tracking_around_loops_ms"], key);
      text += "," + part(b["merge_ms"], "mean") + "," + part(b["host_peak_mib"], "max") + "," +
              part(b["device_peak_mib"], "max") + "," + part(b["device_transfers_mib"], "max") +
              "\n";
    }
  });
  return text;
}

}  // namespace fastloop::eval
