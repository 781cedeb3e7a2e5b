// Lists the Gaussians of a bin that may touch each 4 x 4 block. A bin is processed in segments of bounded length, so that
// a thread's working set fits its cache however many Gaussians overlap.
#pragma once

#include "bins.hpp"

namespace clear {

inline constexpr int kSegment = 2048;
inline constexpr int kListStride = kSegment + 32;  // lists exactly 4 KiB apart would share the same cache lines

// A segment of a bin: its Gaussians, contiguous and with centres relative to the bin's corner, and for each block the
// indices of those that reach it, in order.
template <class T>
struct Segment {
  Buffer<Ellipse<T>> ellipses;
  Buffer<std::uint16_t> places;  // [block][kListStride]
  int lengths[kBlocks];
  std::int64_t first;  // the segment's first pair, counted from the bin's first
  int count;

  Segment() {
    ellipses.reserve_lost(kSegment);
    places.reserve_lost(std::size_t(kBlocks) * kListStride);
  }
  const std::uint16_t* list(int block) const { return places.data() + std::size_t(block) * kListStride; }
};

// The blocks of the bin that each of sixteen Gaussians reaches, with centres (u, v) relative to the bin's corner. For each
// row of blocks: the leftmost and rightmost point of the ellipse within the row, exact up to a margin of 1e-3 px. Rows are
// counted from the first one that a Gaussian may reach: most reach three of eight at most.
template <class T>
CLEAR_INLINE void block_masks(const Lanes<T> (&e)[kLanes], const Lanes<T>& u, const Lanes<T>& v, std::uint64_t* masks) {
  using L = Lanes<T>;
  const L A = e[kA], S = e[kS], D = e[kD], reach = e[kReach], half_x = e[kHalfX], half_y = e[kHalfY];
  const L one = T(1), zero = T(0), slack = T(1e-3), eight = T(kBlocksAcross);
  const L inverse = one / maximum(half_y, L(T(1e-20)));
  const L width = root(reach / A);                     // half the chord through the centre
  const L widest = -A * S / (A * S * S + D) * half_x;  // dy of the rightmost point; the leftmost lies opposite
  const L reach_y = half_y + L(T(0.01));  // so that no rounding leaves a row out
  const L top = maximum(floor((v - reach_y - L(T(kBlock - 0.5))) * L(T(1) / kBlock)), zero);
  const L bottom = minimum(floor((v + reach_y - L(T(0.5))) * L(T(1) / kBlock)), L(T(kBlocksAcross - 1)));
  std::uint32_t low[kLanes] = {}, high[kLanes] = {};
  for (int nth = 0; nth < kBlocksAcross; ++nth) {
    const L row = top + L(T(nth));
    if (!(row <= bottom).any()) break;
    L first = (row * L(T(kBlock)) + L(T(0.5))) - v, last = first + L(T(kBlock - 1));
    Mask<T> touches = (first <= half_y + slack) & (last >= -half_y - slack) & (row <= bottom);
    L from = maximum(first, -half_y), to = minimum(last, half_y);
    L dy_right = clamp(widest, from, to), dy_left = clamp(-widest, from, to);
    L t_right = dy_right * inverse, t_left = dy_left * inverse;
    L right = u - S * dy_right + width * root(maximum(one - t_right * t_right, zero)) + slack;
    L left = u - S * dy_left - width * root(maximum(one - t_left * t_left, zero)) - slack;
    // Blocks c with a pixel centre 4c + 0.5 … 4c + 3.5 in [left, right]; `end` is one past the last.
    L begin = clamp(-floor((L(T(3.5)) - left) * L(T(0.25))), zero, eight);
    L end = clamp(floor((right - L(T(0.5))) * L(T(0.25))) + one, zero, eight);
    Mask<T> some = touches & (begin < end);
    L bits = where(some, scale_by_power(one, end) - scale_by_power(one, begin));  // 2^end - 2^begin
    T values[kLanes];
    bits.store(values);
    std::uint32_t* half = nth < 4 ? low : high;
    for (int i = 0; i < kLanes; ++i) half[i] |= std::uint32_t(std::int32_t(values[i])) << (8 * (nth & 3));
  }
  T tops[kLanes];
  minimum(top, L(T(kBlocksAcross - 1))).store(tops);
  for (int i = 0; i < kLanes; ++i)
    masks[i] = (std::uint64_t(high[i]) << 32 | low[i]) << (kBlocksAcross * std::int32_t(tops[i]));
}

// The blocks of a bin that lie in the image, as bits.
inline std::uint64_t blocks_in_image(int bin_x, int bin_y, int width, int height) {
  const int columns = std::min(kBlocksAcross, (width - bin_x * kBin + kBlock - 1) / kBlock);
  const int rows = std::min(kBlocksAcross, (height - bin_y * kBin + kBlock - 1) / kBlock);
  std::uint64_t row = (1u << columns) - 1, all = 0;
  for (int y = 0; y < rows; ++y) all |= row << (kBlocksAcross * y);
  return all;
}

// Gathers a segment's Gaussians and lists those of each block. Masks are computed once and kept for the backward pass.
template <class T>
void gather(const Buffer<Ellipse<T>>& ellipses, Bins& bins, int bin, std::int64_t first, std::uint64_t inside,
            Segment<T>& out) {
  const std::int64_t begin = bins.starts[bin] + first;
  const int n = out.count = int(std::min<std::int64_t>(kSegment, bins.starts[bin + 1] - begin));
  out.first = first;
  const std::uint32_t* pairs = bins.pairs.data() + begin;
  std::uint64_t* masks = bins.masks.data() + begin;
  const Band& band = bins.band;
  const T X = T((band.x0 + bin % band.columns()) * kBin), Y = T((band.y0 + bin / band.columns()) * kBin);
  std::uint16_t* next[kBlocks];
  for (int b = 0; b < kBlocks; ++b) next[b] = out.places.data() + std::size_t(b) * kListStride;
  constexpr int ahead = 24;
  for (int i = 0; i < std::min(n, ahead); ++i) __builtin_prefetch(&ellipses[pairs[i]]);
  for (int start = 0; start < n; start += kLanes) {
    const int count = std::min(kLanes, n - start);
    Lanes<T> rows[kLanes];
    for (int i = 0; i < kLanes; ++i) {
      const int at = start + std::min(i, count - 1);
      if (at + ahead < n) __builtin_prefetch(&ellipses[pairs[at + ahead]]);
      rows[i] = Lanes<T>::load(&ellipses[pairs[at]].u);
      if (i < count) {
        Ellipse<T>& mine = out.ellipses[at];
        rows[i].store(&mine.u);
        mine.u += mine.whole_u - X, mine.v += mine.whole_v - Y;  // relative to the bin's corner from here on
      }
    }
    if (!bins.has_masks) {
      std::uint64_t fresh[kLanes];
      transpose(rows);
      block_masks(rows, rows[kU] + (rows[kWholeU] - Lanes<T>(X)), rows[kV] + (rows[kWholeV] - Lanes<T>(Y)), fresh);
      for (int i = 0; i < count; ++i) masks[start + i] = fresh[i] & inside;
    }
    for (int i = 0; i < count; ++i)
      for (std::uint64_t m = masks[start + i]; m; m &= m - 1) *next[__builtin_ctzll(m)]++ = std::uint16_t(start + i);
  }
  for (int b = 0; b < kBlocks; ++b) out.lengths[b] = int(next[b] - out.list(b));
}

}  // namespace clear
