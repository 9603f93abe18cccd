#pragma once

#include "fastloop/place/vocabulary.hpp"

namespace fastloop::place {

/// The vocabulary that ships with the project, part of the library: no file to find at run time.
/// Trained on simulator renders by scripts/train_vocabulary.sh. Unpacked at the first call;
/// thread-safe.
const Vocabulary& default_vocabulary();

}  // namespace fastloop::place
