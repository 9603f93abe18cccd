#pragma once

#include <string>
#include <vector>

#include "fastloop/eval/run_folder.hpp"

namespace fastloop::eval {

/// Builds the body of a page from a few kinds of parts. What is called text is escaped; what is
/// called html is not.
class HtmlPage {
 public:
  void section(const std::string& title);  ///< ends the one before
  void paragraph(const std::string& text);
  /// A picture with a caption; nothing when the picture is empty.
  void figure(const std::string& svg, const std::string& caption);
  void begin_figures();  ///< figures stand side by side where there is room
  void end_figures();
  /// Tables scroll sideways where there is no room. Cells are html; one that
  /// begins with <td or <th is taken as it is.
  void table(const std::vector<std::string>& head,
             const std::vector<std::vector<std::string>>& rows);
  /// Large numbers with their names; html.
  void cards(const std::vector<std::pair<std::string, std::string>>& cards);
  void html(const std::string& html) { body_ += html; }

  /// The whole page: no script, nothing fetched from anywhere.
  std::string str(const std::string& title, const std::string& subtitle) const;

 private:
  std::string body_;
  bool in_section_ = false;
};

/// A number of a JSON file, rounded for reading, that says where it is from: data-key is the path
/// in the file, data-value the number as it stands there.
std::string number_html(const std::string& key, const Json& value, int decimals,
                        const std::string& unit = "");

/// Results of `fastloop bench`, as sections of a page.
void add_bench(HtmlPage& page, const Json& table, std::size_t index);

}  // namespace fastloop::eval
