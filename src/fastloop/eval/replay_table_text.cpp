// Tables of replayed loops as Markdown, CSV and charts.
#include <algorithm>
#include <optional>

#include "fastloop/eval/replay_table.hpp"
#include "fastloop/eval/svg.hpp"

namespace fastloop::eval {
namespace {

std::string text_of(const Json& j) {
  return j.get<std::string>();
}

std::string row(const std::vector<std::string>& cells) {
  std::string text;
  for (const std::string& cell : cells) text += "| " + cell + " ";
  return text + "|\n";
}

std::string head(const std::vector<std::string>& cells) {
  return row(cells) + row(std::vector<std::string>(cells.size(), "---"));
}

std::string columns_table(const Json& table) {
  std::vector<std::string> cells{"map", "keyframes", "poses", "edges", "back end"};
  for (const PaperColumn& c : paper_columns()) cells.push_back(c.title);
  std::string text = head(cells);
  for (const Json& c : table["cases"]) {
    for (const auto& [backend, b] : c["backends"].items()) {
      if (b.is_null()) continue;
      cells = {text_of(c["name"]), c["keyframes"].dump(), c["poses"].dump(), c["edges"].dump(),
               backend};
      for (const PaperColumn& column : paper_columns()) {
        std::string cell = mean_and_sd(b["columns_ms"][column.key]);
        if (c["speed_up"].contains(backend) && c["speed_up"][backend].contains(column.key))
          cell += " (" + three_digits(c["speed_up"][backend][column.key].get<double>()) + "x)";
        cells.push_back(cell);
      }
      text += row(cells);
    }
  }
  return text;
}

/// Median of a stage, or nothing where the back end has no such stage.
std::optional<double> stage_median(const Json& backend, const std::string& stage) {
  if (backend.is_null() || !backend["stages_ms"].contains(stage)) return std::nullopt;
  return backend["stages_ms"][stage]["median"].get<double>();
}

std::vector<std::string> stages_of(const Json& c) {
  std::vector<std::string> names;
  for (const auto& [backend, b] : c["backends"].items()) {
    if (b.is_null()) continue;
    for (const auto& [stage, s] : b["stages_ms"].items())
      if (std::find(names.begin(), names.end(), stage) == names.end()) names.push_back(stage);
  }
  return names;
}

std::string stages_table(const Json& table, const Json& c) {
  std::vector<std::string> cells{"stage"};
  for (const Json& backend : table["backends"]) cells.push_back(text_of(backend) + " ms");
  for (std::size_t b = 1; b < table["backends"].size(); ++b)
    cells.push_back("speed-up of " + text_of(table["backends"][b]));
  std::string text = head(cells);
  for (const std::string& stage : stages_of(c)) {
    cells = {stage};
    for (const auto& [backend, b] : c["backends"].items())
      cells.push_back(stage_median(b, stage) ? mean_and_sd(b["stages_ms"][stage]) : "-");
    const auto base = stage_median(c["backends"].front(), stage);
    for (std::size_t b = 1; b < table["backends"].size(); ++b) {
      const auto ms = stage_median(c["backends"][text_of(table["backends"][b])], stage);
      cells.push_back(base && ms && *ms > 0.005 && *base > 0.005 ? three_digits(*base / *ms) : "-");
    }
    text += row(cells);
  }
  return text;
}

std::string remarks(const Json& table) {
  std::string text;
  for (const Json& c : table["cases"]) {
    const std::string name = "- " + text_of(c["name"]) + ": ";
    if (text_of(c["verdict"]) != "accepted")
      text += name + text_of(c["verdict"]) + ", " + text_of(c["reason"]) + "\n";
    if (!c["decisions_equal"].get<bool>()) text += name + "back ends DECIDED DIFFERENTLY\n";
    if (!c["map_mib"].is_null() && c["keyframes"].get<double>() > 0)
      text += name + "the map takes " + decimal(c["map_mib"].get<double>(), 0) + " MiB, " +
              decimal(1024 * c["map_mib"].get<double>() / c["keyframes"].get<double>(), 0) +
              " KiB a keyframe\n";
    for (const Json& note : c["notes"]) text += name + text_of(note) + "\n";
  }
  return text;
}

constexpr const char* kColours[] = {"#111111", "#1f6fc4", "#c4441f", "#2a7f3f", "#8a3fb0"};

/// Cases that were measured with two back ends, and have a graph.
template <class Use>
void for_each_speed_up(const Json& table, const std::string& backend, const Use& use) {
  for (const Json& c : table["cases"])
    if (c["speed_up"].contains(backend) && c["poses"].get<int>() > 0)
      use(c, c["speed_up"][backend]);
}

}  // namespace

std::string replay_table_markdown(const Json& table) {
  std::string text =
      provenance_markdown(table) +
      "\nTimes of one loop in ms, mean ± standard deviation over the runs; in brackets the "
      "speed-up against the first back end (ratio of medians).\n\n" +
      columns_table(table);
  for (const Json& c : table["cases"])
    text += "\n" + text_of(c["name"]) + ", stage by stage:\n\n" + stages_table(table, c);
  const std::string notes = remarks(table);
  if (!notes.empty()) text += "\nRemarks\n\n" + notes;
  return text;
}

std::string replay_table_csv(const Json& table) {
  std::string text =
      "map,keyframes,landmarks,poses,edges,backend,what,runs,mean_ms,sd_ms,median_ms,min_ms,max_"
      "ms\n";
  for (const Json& c : table["cases"]) {
    for (const auto& [backend, b] : c["backends"].items()) {
      if (b.is_null()) continue;
      const std::string begin = text_of(c["name"]) + "," + c["keyframes"].dump() + "," +
                                c["landmarks"].dump() + "," + c["poses"].dump() + "," +
                                c["edges"].dump() + "," + backend + ",";
      for (const char* group : {"columns_ms", "stages_ms"})
        for (const auto& [what, s] : b[group].items()) {
          text += begin + (std::string(group) == "columns_ms" ? "column " : "stage ") + what + "," +
                  s["count"].dump();
          for (const char* key : {"mean", "sd", "median", "min", "max"})
            text += "," + s[key].dump();
          text += "\n";
        }
    }
  }
  return text;
}

std::string speed_up_chart(const Json& table, ScaleAxis axis, const std::string& backend) {
  Chart chart;
  const char* key = axis == ScaleAxis::kPoses ? "poses" : "edges";
  chart.x_label = axis == ScaleAxis::kPoses ? "poses of the graph" : "edges of the graph";
  chart.y_label = "speed-up of " + backend;
  chart.x_log = chart.y_log = true;
  std::size_t colour = 0;
  for (const PaperColumn& column : paper_columns()) {
    Series s{column.title, kColours[colour++], {}, {}, 1.5, true};
    for_each_speed_up(table, backend, [&](const Json& c, const Json& speed_up) {
      if (speed_up.contains(column.key))
        s.points.push_back({c[key].get<double>(), speed_up[column.key].get<double>()});
    });
    chart.series.push_back(s);
  }
  return draw_chart(chart, 340);
}

std::string time_chart(const Json& table) {
  Chart chart;
  chart.x_label = "keyframes of the map";
  chart.y_label = "loop closing [ms]";
  chart.x_log = chart.y_log = true;
  std::size_t colour = 0;
  for (const Json& backend : table["backends"]) {
    Series s{text_of(backend), kColours[colour++ % 5], {}, {}, 1.5, true};
    for (const Json& c : table["cases"]) {
      const Json& b = c["backends"][text_of(backend)];
      if (!b.is_null())
        s.points.push_back(
            {c["keyframes"].get<double>(), b["columns_ms"]["total"]["median"].get<double>()});
    }
    chart.series.push_back(s);
  }
  return draw_chart(chart, 340);
}

std::string speed_up_svg(const Json& table) {
  std::string body;
  double y = 0;
  for (std::size_t b = 1; b < table["backends"].size(); ++b) {
    double x = 0;
    for (const ScaleAxis axis : {ScaleAxis::kPoses, ScaleAxis::kEdges}) {
      const std::string chart = speed_up_chart(table, axis, text_of(table["backends"][b]));
      if (chart.empty()) continue;
      body += "<g transform=\"translate(" + decimal(x, 0) + " " + decimal(y, 0) + ")\">" +
              "<svg width=\"" + decimal(kChartWidth, 0) + "\" height=\"340\"" + chart.substr(4) +
              "</g>\n";
      x += kChartWidth;
    }
    y += 340;
  }
  if (body.empty()) return "";
  const std::string size =
      "width=\"" + decimal(2 * kChartWidth, 0) + "\" height=\"" + decimal(y, 0) + "\"";
  return "<svg xmlns=\"http://www.w3.org/2000/svg\" " + size +
         ">\n<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n" + body + "</svg>\n";
}

}  // namespace fastloop::eval
