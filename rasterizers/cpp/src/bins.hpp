// Bin, second half: which Gaussians may touch which 32 x 32 bin, front to back, by a stable counting scatter.
//
// A pair of bin and Gaussian also owns a slot for what the bin sends back. Slots are numbered Gaussian by Gaussian, so
// that the way back reads them in one stream; their order, not the scheduling of threads, fixes the order of the sums.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <string>

#include "pool.hpp"
#include "types.hpp"

namespace clear {

struct Pair {
  std::uint32_t splat, slot;
};

// A rectangle of bins, both ends included; empty if x1 < x0.
struct BinRange {
  std::int16_t x0 = 0, x1 = -1, y0 = 0, y1 = -1;
  std::int64_t count() const { return x1 < x0 || y1 < y0 ? 0 : std::int64_t(x1 - x0 + 1) * (y1 - y0 + 1); }
};

// The pairs of some rows of bins ("band"): all rows at once, unless that would not fit the memory budget.
struct Bins {
  int columns = 0, first_row = 0, end_row = 0;
  Buffer<Pair> pairs;                 // by bin, then depth, then index
  std::vector<std::int64_t> starts;   // [bins of the band + 1]
  Buffer<std::uint64_t> masks;        // of each pair: the blocks of its bin that its ellipse reaches (set by blocks.hpp)
  Buffer<std::uint32_t> slots;        // [n + 1]: the slots of Gaussian i are slots[i] … slots[i + 1]
  bool has_masks = false;

  int bins() const { return columns * (end_row - first_row); }
};

// The bins whose pixel centres the ellipse's box covers.
template <class T>
CLEAR_INLINE BinRange bins_of(const Ellipse<T>& e, const Screen<T>& s) {
  if (!(e.reach > 0)) return {};
  T left = e.u - e.half_x - T(0.5), right = e.u + e.half_x - T(0.5);
  T top = e.v - e.half_y - T(0.5), bottom = e.v + e.half_y - T(0.5);
  if (!(right >= 0 && bottom >= 0 && left <= T(s.width - 1) && top <= T(s.height - 1))) return {};
  auto bin = [](T pixel, int size) { return std::int16_t(int(std::clamp(pixel, T(0), T(size - 1))) / kBin); };
  return {bin(left, s.width), bin(right, s.width), bin(top, s.height), bin(bottom, s.height)};
}

// Every Gaussian's bins, and how many pairs each row of bins has in all: 64-bit, a full screen times a million is 10^9.
template <class T>
void cover(const Screen<T>& screen, const Buffer<Ellipse<T>>& ellipses, std::int64_t n, Buffer<BinRange>& ranges,
           std::vector<std::int64_t>& pairs_in_row, int threads) {
  const int rows = screen.rows();
  const std::int64_t chunk = 4096, chunks = (n + chunk - 1) / chunk;
  ranges.reserve_lost(n);
  std::vector<std::int64_t> steps(std::size_t(chunks) * (rows + 1), 0);  // differences from row to row
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    std::int64_t* step = steps.data() + c * (rows + 1);
    for (std::int64_t i = c * chunk; i < std::min(n, (c + 1) * chunk); ++i) {
      BinRange r = ranges[i] = bins_of(ellipses[i], screen);
      if (!r.count()) continue;
      step[r.y0] += r.x1 - r.x0 + 1;
      step[r.y1 + 1] -= r.x1 - r.x0 + 1;
    }
  });
  pairs_in_row.assign(rows, 0);
  std::int64_t running = 0;
  for (int row = 0; row < rows; ++row) {
    for (std::int64_t c = 0; c < chunks; ++c) running += steps[c * (rows + 1) + row];
    pairs_in_row[row] = running;
  }
}

// List the pairs of rows [first_row, end_row). `wanted[bin]` (or null) leaves out bins that nobody asked for.
inline void list_pairs(int columns, int first_row, int end_row, const Buffer<std::uint32_t>& order,
                       const Buffer<BinRange>& ranges, std::int64_t n, const std::uint64_t* wanted, Bins& out, int threads) {
  out.columns = columns, out.first_row = first_row, out.end_row = end_row, out.has_masks = false;
  const int bins = out.bins();
  auto clipped = [&](std::uint32_t i) {
    BinRange r = ranges[i];
    r.y0 = std::max<int>(r.y0, first_row), r.y1 = std::min<int>(r.y1, end_row - 1);
    return r;
  };
  auto each_bin = [&](const BinRange& r, auto&& visit) {
    for (int y = r.y0; y <= r.y1; ++y)
      for (int x = r.x0; x <= r.x1; ++x)
        if (!wanted || wanted[y * columns + x]) visit((y - first_row) * columns + x);
  };

  // Slots, Gaussian by Gaussian.
  const std::int64_t chunk = 16384, chunks = (n + chunk - 1) / chunk;
  std::vector<std::int64_t> base(chunks + 1, 0);
  out.slots.reserve_lost(n + 1);
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    std::int64_t count = 0;
    for (std::int64_t i = c * chunk; i < std::min(n, (c + 1) * chunk); ++i) {
      out.slots[i] = std::uint32_t(count);
      BinRange r = clipped(std::uint32_t(i));
      if (wanted) each_bin(r, [&](int) { ++count; });
      else count += r.count();
    }
    base[c + 1] = count;
  });
  for (std::int64_t c = 0; c < chunks; ++c) base[c + 1] += base[c];
  if (base[chunks] > std::int64_t(UINT32_MAX)) throw std::length_error("more than 2^32 pairs in one band");
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    for (std::int64_t i = c * chunk; i < std::min(n, (c + 1) * chunk); ++i) out.slots[i] += std::uint32_t(base[c]);
  });
  out.slots[n] = std::uint32_t(base[chunks]);

  // Pairs, front to back within each bin: count by part of the depth order, then scatter part by part.
  const std::int64_t m = std::int64_t(order.size());
  const int parts = m < 4096 ? 1 : std::max(1, threads);
  std::vector<std::uint32_t> places(std::size_t(parts) * bins, 0);
  auto each_pair = [&](std::int64_t part, auto&& visit) {
    constexpr int ahead = 16;
    const std::int64_t end = m * (part + 1) / parts;
    for (std::int64_t k = m * part / parts; k < end; ++k) {
      if (k + ahead < end) __builtin_prefetch(&ranges[order[k + ahead]]);
      const std::uint32_t i = order[k];
      each_bin(clipped(i), [&, nth = 0](int bin) mutable { visit(i, bin, nth++); });
    }
  };
  Pool::instance().run(threads, parts, [&](std::int64_t part) {
    std::uint32_t* count = places.data() + part * bins;
    each_pair(part, [&](std::uint32_t, int bin, int) { ++count[bin]; });
  });
  out.starts.assign(bins + 1, 0);
  std::uint32_t place = 0;
  for (int bin = 0; bin < bins; ++bin) {
    out.starts[bin] = place;
    for (int part = 0; part < parts; ++part) place += std::exchange(places[std::size_t(part) * bins + bin], place);
  }
  out.starts[bins] = place;
  out.pairs.reserve_lost(place);
  out.masks.reserve_lost(place);
  Pool::instance().run(threads, parts, [&](std::int64_t part) {
    std::uint32_t* next = places.data() + part * bins;
    each_pair(part, [&](std::uint32_t i, int bin, int nth) { out.pairs[next[bin]++] = {i, out.slots[i] + nth}; });
  });
}

}  // namespace clear
