#pragma once

/// FASTLOOP_WIDE compiles a function a second time for processors with AVX2 and takes the better
/// one when the program starts. Lanes stay independent and multiplications and additions are not
/// contracted, so both give the same bits. What the function calls is inlined, otherwise it would
/// stay narrow. ThreadSanitizer cannot start functions chosen this way.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(__SANITIZE_THREAD__) && !defined(__SANITIZE_ADDRESS__)
#define FASTLOOP_WIDE __attribute__((target_clones("avx2", "default"), flatten))
#else
#define FASTLOOP_WIDE
#endif
