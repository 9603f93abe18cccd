#include "fastloop/place/default_vocabulary.hpp"

#include "fastloop/place/vocabulary_io.hpp"

// The file becomes part of the object code; the build names it in FASTLOOP_DEFAULT_VOCABULARY.
asm(".pushsection .rodata\n"
    ".hidden fastloop_default_vocabulary_begin\n"
    ".hidden fastloop_default_vocabulary_end\n"
    ".global fastloop_default_vocabulary_begin\n"
    ".global fastloop_default_vocabulary_end\n"
    ".balign 16\n"
    "fastloop_default_vocabulary_begin:\n"
    ".incbin \"" FASTLOOP_DEFAULT_VOCABULARY
    "\"\n"
    "fastloop_default_vocabulary_end:\n"
    ".byte 0\n"
    ".popsection\n");

extern "C" {
__attribute__((visibility("hidden"))) extern const std::byte fastloop_default_vocabulary_begin[];
__attribute__((visibility("hidden"))) extern const std::byte fastloop_default_vocabulary_end[];
}

namespace fastloop::place {

const Vocabulary& default_vocabulary() {
  static const Vocabulary vocabulary(parse_vocabulary(
      {fastloop_default_vocabulary_begin, fastloop_default_vocabulary_end}, "default vocabulary"));
  return vocabulary;
}

}  // namespace fastloop::place
