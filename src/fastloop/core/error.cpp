#include "fastloop/core/error.hpp"

namespace fastloop {
namespace {

std::string compose(const InputError::Where& where, const std::string& message,
                    const std::string& expected) {
  std::string text = where.file;
  if (where.line > 0) text += ":" + std::to_string(where.line);
  if (!text.empty()) text += ": ";
  if (!where.key.empty()) text += where.key + ": ";
  text += message;
  if (!expected.empty()) text += " (expected " + expected + ")";
  return text;
}

}  // namespace

InputError::InputError(Where where, const std::string& message, const std::string& expected)
    : Error(compose(where, message, expected)), where_(std::move(where)) {}

}  // namespace fastloop
