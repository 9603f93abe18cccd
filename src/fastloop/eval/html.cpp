#include "fastloop/eval/html.hpp"

#include "fastloop/eval/svg.hpp"

namespace fastloop::eval {
namespace {

constexpr const char* kStyle = R"(
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0; background: #f4f5f7; color: #1c1f23; line-height: 1.45;
  font: 15px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 20px 16px 40px; }
h1 { font-size: 1.6rem; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 0 0 10px; }
h3 { font-size: 1rem; margin: 18px 0 6px; }
p { margin: 6px 0 10px; }
.subtitle { color: #5a626b; margin: 2px 0 14px; overflow-wrap: anywhere; }
section { background: #fff; border: 1px solid #dfe2e6; border-radius: 8px; padding: 14px 16px; margin: 0 0 16px; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(136px, 1fr)); gap: 10px; margin: 0 0 16px; }
.card { background: #fff; border: 1px solid #dfe2e6; border-radius: 8px; padding: 10px 12px; }
.card b { display: block; font-size: 1.25rem; font-weight: 600; white-space: nowrap; }
.card span.name { color: #5a626b; font-size: 0.82rem; }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 420px), 1fr)); gap: 12px 20px; }
figure { margin: 0; min-width: 0; }
figure svg { display: block; width: 100%; height: auto; }
figcaption { color: #5a626b; font-size: 0.85rem; margin-top: 2px; }
.scroll { overflow-x: auto; margin: 4px 0 10px; }
table { border-collapse: collapse; font-size: 0.86rem; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 10px 4px 0; text-align: right; vertical-align: top; border-bottom: 1px solid #eceef0; white-space: nowrap; }
th { color: #5a626b; font-weight: 600; white-space: normal; vertical-align: bottom; }
th:first-child, td:first-child, td.words, th.words { text-align: left; }
td.long { white-space: normal; min-width: 9em; text-align: left; }
code { font-size: 0.86em; overflow-wrap: anywhere; }
@media (max-width: 700px) { th { white-space: nowrap; } }
@media print {
  body { background: #fff; font-size: 11px; }
  main { max-width: none; padding: 0; }
  section, .card { border-color: #bbb; }
  section { break-inside: auto; }
  figure, tr, .card { break-inside: avoid; }
  .scroll { overflow: visible; }
  .figures { grid-template-columns: 1fr 1fr; }
  table { font-size: 8.5px; }
  th, td { padding-right: 6px; white-space: normal; }
}
)";

}  // namespace

void HtmlPage::section(const std::string& title) {
  if (in_section_) body_ += "</section>\n";
  body_ += "<section>\n<h2>" + escaped(title) + "</h2>\n";
  in_section_ = true;
}

void HtmlPage::paragraph(const std::string& text) {
  body_ += "<p>" + escaped(text) + "</p>\n";
}

void HtmlPage::figure(const std::string& svg, const std::string& caption) {
  if (svg.empty()) return;
  body_ += "<figure>\n" + svg + "<figcaption>" + escaped(caption) + "</figcaption>\n</figure>\n";
}

void HtmlPage::begin_figures() {
  body_ += "<div class=\"figures\">\n";
}
void HtmlPage::end_figures() {
  body_ += "</div>\n";
}

void HtmlPage::table(const std::vector<std::string>& head,
                     const std::vector<std::vector<std::string>>& rows) {
  body_ += "<div class=\"scroll\"><table>\n<thead><tr>";
  for (const std::string& cell : head)
    body_ += cell.starts_with("<th") ? cell : "<th>" + cell + "</th>";
  body_ += "</tr></thead>\n<tbody>\n";
  for (const auto& row : rows) {
    body_ += "<tr>";
    for (const std::string& cell : row)
      body_ += cell.starts_with("<td") ? cell : "<td>" + cell + "</td>";
    body_ += "</tr>\n";
  }
  body_ += "</tbody></table></div>\n";
}

void HtmlPage::cards(const std::vector<std::pair<std::string, std::string>>& cards) {
  body_ += "<div class=\"cards\">\n";
  for (const auto& [name, value] : cards)
    body_ += "<div class=\"card\"><b>" + value + "</b><span class=\"name\">" + escaped(name) +
             "</span></div>\n";
  body_ += "</div>\n";
}

std::string HtmlPage::str(const std::string& title, const std::string& subtitle) const {
  return "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n"
         "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n"
         "<link rel=\"icon\" href=\"data:,\">\n<title>" +
         escaped(title) + "</title>\n<style>" + kStyle + "</style>\n</head>\n<body>\n<main>\n<h1>" +
         escaped(title) + "</h1>\n<p class=\"subtitle\">" + escaped(subtitle) + "</p>\n" + body_ +
         (in_section_ ? "</section>\n" : "") + "</main>\n</body>\n</html>\n";
}

std::string number_html(const std::string& key, const Json& value, int decimals,
                        const std::string& unit) {
  if (value.is_null()) return "-";
  return "<span data-key=\"" + escaped(key) + "\" data-value=\"" + value.dump() + "\">" +
         decimal(value.get<double>(), decimals) + "</span>" +
         (unit.empty() ? "" : "&nbsp;" + escaped(unit));
}

}  // namespace fastloop::eval
