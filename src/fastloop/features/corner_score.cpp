#include "fastloop/features/corner_score.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cstring>

#include "fastloop/features/cv_view.hpp"

namespace fastloop {
namespace {

/// The circle of radius 3 around a pixel, clockwise from the top, as in the FAST paper.
constexpr int kCircle[16][2] = {{0, -3}, {1, -3},  {2, -2},  {3, -1}, {3, 0},  {3, 1},
                                {2, 2},  {1, 3},   {0, 3},   {-1, 3}, {-2, 2}, {-3, 1},
                                {-3, 0}, {-3, -1}, {-2, -2}, {-1, -3}};
constexpr int kRadius = 3;
constexpr int kBlock = 32;

/// 32 grey values; the compiler maps operations on them to whatever vectors the target has.
typedef std::uint8_t Bytes __attribute__((vector_size(kBlock)));

static_assert(std::endian::native == std::endian::little);

#define FASTLOOP_INLINE __attribute__((always_inline)) inline

FASTLOOP_INLINE void load(const std::uint8_t* p, Bytes& v) {
  std::memcpy(&v, p, kBlock);
}
FASTLOOP_INLINE void take_min(Bytes& a, const Bytes& b) {
  a = a < b ? a : b;
}
FASTLOOP_INLINE void take_max(Bytes& a, const Bytes& b) {
  a = a > b ? a : b;
}

FASTLOOP_INLINE bool any(const Bytes& v) {
  std::array<std::uint64_t, kBlock / 8> words;
  std::memcpy(words.data(), &v, kBlock);
  return (words[0] | words[1] | words[2] | words[3]) != 0;
}

/// Largest over the sixteen arcs of nine of the smallest value in the arc. Arcs that begin at k and
/// k + 1 share eight values, so each pair costs one minimum: min(shared, max(first, last)).
FASTLOOP_INLINE void best_arc(const Bytes (&d)[16], Bytes& best) {
  Bytes two[8], four[8];  // minima over 2 and 4 values from the odd positions
  for (int i = 0; i < 8; ++i) {
    two[i] = d[2 * i + 1];
    take_min(two[i], d[(2 * i + 2) % 16]);
  }
  for (int i = 0; i < 8; ++i) {
    four[i] = two[i];
    take_min(four[i], two[(i + 1) % 8]);
  }
  for (int i = 0; i < 8; ++i) {
    Bytes eight = four[i], ends = d[2 * i];
    take_min(eight, four[(i + 2) % 8]);
    take_max(ends, d[(2 * i + 9) % 16]);
    take_min(eight, ends);
    if (i == 0)
      best = eight;
    else
      take_max(best, eight);
  }
}

/// Any nine of sixteen include two compass points a quarter apart: without such a pair beyond the
/// floor there is no corner.
FASTLOOP_INLINE bool may_have_corner(const std::uint8_t* centre, std::ptrdiff_t stride,
                                     const Bytes& c, const Bytes& floor) {
  Bytes brighter[4], darker[4];
  for (int i = 0; i < 4; ++i) {
    Bytes p;
    load(centre + kCircle[4 * i][1] * stride + kCircle[4 * i][0], p);
    brighter[i] = p;
    take_max(brighter[i], c);
    brighter[i] -= c;
    darker[i] = c;
    take_max(darker[i], p);
    darker[i] -= p;
  }
  Bytes best = floor;
  for (int i = 0; i < 4; ++i) {
    Bytes b = brighter[i], k = darker[i];
    take_min(b, brighter[(i + 1) % 4]);
    take_min(k, darker[(i + 1) % 4]);
    take_max(best, b);
    take_max(best, k);
  }
  best -= floor;
  return any(best);
}

/// Scores of 32 pixels in a row.
FASTLOOP_INLINE void score_block(const std::uint8_t* centre, std::ptrdiff_t stride,
                                 const Bytes& floor, std::uint8_t* out) {
  Bytes c, score = {};
  load(centre, c);
  if (may_have_corner(centre, stride, c, floor)) {
    Bytes brighter[16], darker[16], dark_score;
    for (int i = 0; i < 16; ++i) {
      Bytes p;
      load(centre + kCircle[i][1] * stride + kCircle[i][0], p);
      brighter[i] = p;
      take_max(brighter[i], c);
      brighter[i] -= c;
      darker[i] = c;
      take_max(darker[i], p);
      darker[i] -= p;
    }
    best_arc(brighter, score);
    best_arc(darker, dark_score);
    take_max(score, dark_score);
    score = score > floor ? score : Bytes{};
  }
  std::memcpy(out, &score, kBlock);
}

/// The image is at least kBlock + 2 * kRadius wide: the last block of a row overlaps the one before
/// it.
FASTLOOP_INLINE void score_rows(const ImageU8& image, std::uint8_t floor, ImageU8& scores) {
  const Bytes floors = Bytes{} + floor;
  const int last = image.width - kRadius - kBlock;
  for (int y = kRadius; y < image.height - kRadius; ++y) {
    const std::uint8_t* in = image.row(y);
    std::uint8_t* out = scores.row(y);
    for (int x = kRadius; x < last; x += kBlock) score_block(in + x, image.width, floors, out + x);
    score_block(in + last, image.width, floors, out + last);
  }
}

/// Keeps a score where it is a peak, else zero; for kBlock pixels.
FASTLOOP_INLINE bool keep_peaks(const std::uint8_t* s, std::ptrdiff_t stride, Bytes& peaks) {
  Bytes centre, v, before, after;
  load(s, centre);
  if (!any(centre)) return false;
  load(s - 1, before);
  load(s + 1, after);
  for (int dx = -1; dx <= 1; ++dx) {
    load(s - stride + dx, v);
    take_max(before, v);
    load(s + stride + dx, v);
    take_max(after, v);
  }
  peaks = centre > before ? centre : Bytes{};
  peaks = centre < after ? Bytes{} : peaks;
  return any(peaks);
}

FASTLOOP_INLINE void collect_peaks(const ImageU8& scores, int border,
                                   std::vector<ScorePeak>& peaks) {
  const int end = scores.width - border;
  Bytes kept;
  std::array<std::uint64_t, kBlock / 8> words;
  for (int y = border; y < scores.height - border; ++y) {
    const std::uint8_t* row = scores.row(y);
    for (int x = border; x < end; x += kBlock) {
      // The last block begins early and skips what the one before it covered.
      const int begin = std::min(x, end - kBlock);
      if (!keep_peaks(row + begin, scores.width, kept)) continue;
      std::memcpy(words.data(), &kept, kBlock);
      for (int w = 0; w < kBlock / 8; ++w)
        for (std::uint64_t word = words[w]; word != 0;) {
          const int byte = std::countr_zero(word) / 8;
          const int px = begin + 8 * w + byte;
          const auto score = static_cast<std::uint8_t>(word >> (8 * byte));
          word &= ~(std::uint64_t{0xff} << (8 * byte));
          if (px >= x)
            peaks.push_back({static_cast<std::int16_t>(px), static_cast<std::int16_t>(y), score});
        }
    }
  }
}

void score_rows_portable(const ImageU8& image, std::uint8_t floor, ImageU8& scores) {
  score_rows(image, floor, scores);
}
void collect_peaks_portable(const ImageU8& scores, int border, std::vector<ScorePeak>& peaks) {
  collect_peaks(scores, border, peaks);
}

#if defined(__x86_64__)
__attribute__((target("avx2"))) void score_rows_avx2(const ImageU8& image, std::uint8_t floor,
                                                     ImageU8& scores) {
  score_rows(image, floor, scores);
}
__attribute__((target("avx2"))) void collect_peaks_avx2(const ImageU8& scores, int border,
                                                        std::vector<ScorePeak>& peaks) {
  collect_peaks(scores, border, peaks);
}
const bool kHasAvx2 = __builtin_cpu_supports("avx2");
#else
constexpr auto score_rows_avx2 = score_rows_portable;
constexpr auto collect_peaks_avx2 = collect_peaks_portable;
constexpr bool kHasAvx2 = false;
#endif

}  // namespace

namespace reference {

int corner_score(const ImageU8& image, int x, int y) {
  int difference[16], score = 0;
  for (int k = 0; k < 16; ++k)
    difference[k] = image.at(x + kCircle[k][0], y + kCircle[k][1]) - image.at(x, y);
  for (int k = 0; k < 16; ++k) {
    int brighter = 255, darker = 255;
    for (int i = 0; i < 9; ++i) {
      brighter = std::min(brighter, difference[(k + i) % 16]);
      darker = std::min(darker, -difference[(k + i) % 16]);
    }
    score = std::max({score, brighter, darker});
  }
  return score;
}

}  // namespace reference

void corner_scores(const ImageU8& image, int floor, ImageU8& scores) {
  resize_storage(scores, image.width, image.height);
  if (image.width < kBlock + 2 * kRadius || image.height < 2 * kRadius + 1) {
    // Too narrow for a block.
    std::fill(scores.pixels.begin(), scores.pixels.end(), std::uint8_t{0});
    for (int y = kRadius; y < image.height - kRadius; ++y)
      for (int x = kRadius; x < image.width - kRadius; ++x) {
        const int score = reference::corner_score(image, x, y);
        scores.at(x, y) = static_cast<std::uint8_t>(score > floor ? score : 0);
      }
    return;
  }
  for (int y = 0; y < image.height; ++y) {
    const bool outside = y < kRadius || y >= image.height - kRadius;
    std::uint8_t* row = scores.row(y);
    std::fill_n(row, outside ? image.width : kRadius, std::uint8_t{0});
    std::fill_n(row + image.width - kRadius, kRadius, std::uint8_t{0});
  }
  (kHasAvx2 ? score_rows_avx2 : score_rows_portable)(image, static_cast<std::uint8_t>(floor),
                                                     scores);
}

void score_peaks(const ImageU8& scores, int border_px, std::vector<ScorePeak>& peaks) {
  peaks.clear();
  const int border = std::max(border_px, kRadius + 1);
  if (scores.width < 2 * border + kBlock) {
    for (int y = border; y < scores.height - border; ++y)
      for (int x = border; x < scores.width - border; ++x) {
        const int s = scores.at(x, y);
        bool peak = s > 0;
        for (int k = 0; peak && k < 9; ++k) {
          const int other = scores.at(x + k % 3 - 1, y + k / 3 - 1);
          peak = k < 4 ? s > other : s >= other;
        }
        if (peak)
          peaks.push_back({static_cast<std::int16_t>(x), static_cast<std::int16_t>(y),
                           static_cast<std::uint8_t>(s)});
      }
    return;
  }
  (kHasAvx2 ? collect_peaks_avx2 : collect_peaks_portable)(scores, border, peaks);
}

}  // namespace fastloop
