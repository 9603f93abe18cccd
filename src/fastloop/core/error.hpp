#pragma once

#include <stdexcept>
#include <string>

namespace fastloop {

/// Base of every exception thrown by fastloop. Ordinary outcomes (lost, no loop) are values, not
/// exceptions.
class Error : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// A caller broke a documented precondition.
class InvalidArgument : public Error {
 public:
  using Error::Error;
};

/// A file, folder or configuration value that cannot be used; the command line exits with code 2.
/// `what()` reads "file:line: key: message (expected ...)", with the parts that are known.
class InputError : public Error {
 public:
  struct Where {
    std::string file;
    int line = 0;  ///< 1-based; 0 when unknown
    std::string key;
  };
  InputError(Where where, const std::string& message, const std::string& expected = "");
  const Where& where() const { return where_; }

 private:
  Where where_;
};

}  // namespace fastloop
