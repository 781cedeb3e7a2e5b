// Bin, second half: lists the Gaussians that may touch each 32 x 32 bin, front to back, by a stable counting scatter.
//
// The backward pass stores each (Gaussian, bin) pair's sums at the pair's place, so bins write sequentially. A Gaussian
// finds its pairs by `where`, in a fixed order, so the order of its sums does not depend on thread scheduling.
#pragma once

#include <algorithm>

#include "groups.hpp"
#include "pool.hpp"

namespace clear {

// A rectangle of bins, both ends included; empty if x1 = x0 - 1 or y1 = y0 - 1.
struct BinRange {
  std::int16_t x0 = 0, x1 = -1, y0 = 0, y1 = -1;
  std::int64_t count() const { return std::int64_t(x1 + 1 - x0) * std::int64_t(y1 + 1 - y0); }

  // Calls visit(x, y) for each bin, row by row: one loop, because the ends of two are predicted worse.
  template <class Visit>
  void each(Visit&& visit) const {
    std::int64_t left = count();
    for (int x = x0, y = y0; left; --left) {
      visit(x, y);
      const bool last = x == x1;
      x = last ? x0 : x + 1, y += last;
    }
  }
};

// A rectangle of bins whose pairs are listed at once, ends excluded: whole rows of bins, or a part of one row. There is one
// band, unless its pairs would not fit the memory budget.
struct Band {
  int x0 = 0, x1 = 0, y0 = 0, y1 = 0;
  int columns() const { return x1 - x0; }
  int bins() const { return columns() * (y1 - y0); }
  bool operator==(const Band&) const = default;
};

// The pairs of a band.
struct Bins {
  Band band;
  Buffer<std::uint32_t> pairs;        // the Gaussian of each pair; by bin, then depth, then index
  std::vector<std::int64_t> starts;   // [bins of the band + 1]
  Buffer<std::uint64_t> masks;        // by pair: the blocks of its bin that its ellipse reaches (set by blocks.hpp)
  Buffer<std::uint32_t> first;        // [n + 1]: Gaussian i's pairs are where[first[i]] … where[first[i + 1] - 1]
  Buffer<std::uint32_t> where;        // indices into `pairs` by Gaussian, from its top left bin on
  bool has_masks = false;
};

// How many rectangles cover each bin of a band. Sums of differences along both axes: adding a rectangle is no loop over its
// bins, whose end would be mispredicted.
class Coverage {
 public:
  explicit Coverage(const Band& band) : band_(band), width_(band.columns() + 1), steps_(width_ * (band.y1 - band.y0 + 1), 0) {}

  void add(const BinRange& r) {
    std::uint32_t *top = at(r.x0, r.y0), *bottom = at(r.x0, r.y1 + 1);
    const int across = r.x1 + 1 - r.x0;
    ++top[0], --top[across], --bottom[0], ++bottom[across];
  }

  // Calls visit(bin of the band, count) for each bin.
  template <class Visit>
  void each(Visit&& visit) {
    for (int y = band_.y0, bin = 0; y < band_.y1; ++y) {
      std::uint32_t running = 0;
      for (int x = band_.x0; x < band_.x1; ++x, ++bin) {
        running += *at(x, y);
        visit(bin, *at(x, y) = running + (y > band_.y0 ? *at(x, y - 1) : 0));
      }
    }
  }

 private:
  std::uint32_t* at(int x, int y) { return &steps_[(y - band_.y0) * width_ + x - band_.x0]; }

  Band band_;
  std::size_t width_;
  std::vector<std::uint32_t> steps_;
};

// Lists the pairs of a band of the image.
inline void list_pairs(const Band& band, const Band& image, const Drawn& drawn, const Buffer<std::uint32_t>& order,
                       const Buffer<BinRange>& ranges, Bins& out, int threads) {
  out.band = band, out.has_masks = false;
  const int bins = band.bins();
  auto clipped = [&](std::uint32_t i) {
    BinRange r = ranges[i];
    r.x0 = std::min(std::max<int>(r.x0, band.x0), band.x1), r.x1 = std::max(std::min<int>(r.x1, band.x1 - 1), r.x0 - 1);
    r.y0 = std::min(std::max<int>(r.y0, band.y0), band.y1), r.y1 = std::max(std::min<int>(r.y1, band.y1 - 1), r.y0 - 1);
    return r;
  };
  auto each_bin = [&](const BinRange& r, auto&& visit) {
    r.each([&](int x, int y) { visit((y - band.y0) * band.columns() + x - band.x0); });
  };

  // Count each Gaussian's pairs, and add the counts up.
  const std::int64_t n = std::int64_t(ranges.size()), chunks = drawn.chunks();
  std::vector<std::uint32_t> base(chunks + 1, 0);
  out.first.reserve_lost(n + 1);
  std::uint32_t* counts = out.first.data() + 1;
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    const std::int64_t begin = c * kChunk, end = std::min(n, begin + kChunk);
    std::uint32_t pairs = 0;
    if (band == image) {  // a loop that the compiler turns into one over registers
      for (std::int64_t i = begin; i < end; ++i) pairs += counts[i] = std::uint32_t(ranges[i].count());
    } else {
      std::fill(counts + begin, counts + end, 0);
      for (const std::uint32_t* i = drawn.begin(c); i < drawn.end(c); ++i)
        pairs += counts[*i] = std::uint32_t(clipped(*i).count());
    }
    base[c + 1] = pairs;
  });
  for (std::int64_t c = 0; c < chunks; ++c) base[c + 1] += base[c];
  out.first[0] = 0;
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    std::uint32_t place = base[c];
    for (std::int64_t i = c * kChunk; i < std::min(n, (c + 1) * kChunk); ++i) counts[i] = place += counts[i];
  });

  // List the pairs front to back within each bin: count in parts of the depth order, then scatter part by part. The first
  // pass reads in random order and stores what the second then reads sequentially.
  struct Ranked {
    BinRange range;
    std::uint32_t splat, first;
  };
  const std::int64_t m = std::int64_t(order.size());
  const int parts = m < 4096 ? 1 : std::max(1, threads);
  const std::size_t stride = (bins + 31) / 16 * 16;  // two parts never write to one cache line
  std::vector<std::uint32_t> places(parts * stride, 0);
  Buffer<Ranked> ranked;
  ranked.reserve_lost(m);
  auto part_of = [&](std::int64_t part) { return std::pair(m * part / parts, m * (part + 1) / parts); };
  Pool::instance().run(threads, parts, [&](std::int64_t part) {
    constexpr int ahead = 16;
    Coverage coverage(band);
    auto [begin, end] = part_of(part);
    for (std::int64_t k = begin; k < end; ++k) {
      if (k + ahead < end) {
        __builtin_prefetch(&ranges[order[k + ahead]]);
        __builtin_prefetch(&out.first[order[k + ahead]]);
      }
      ranked[k] = {clipped(order[k]), order[k], out.first[order[k]]};
      coverage.add(ranked[k].range);
    }
    coverage.each([&](int bin, std::uint32_t count) { places[part * stride + bin] = count; });
  });
  out.starts.assign(bins + 1, 0);
  std::uint32_t place = 0;
  for (int bin = 0; bin < bins; ++bin) {
    out.starts[bin] = place;
    for (int part = 0; part < parts; ++part) place += std::exchange(places[part * stride + bin], place);
  }
  out.starts[bins] = place;
  out.pairs.reserve_lost(place);
  out.masks.reserve_lost(place);
  out.where.reserve_lost(place);
  Pool::instance().run(threads, parts, [&](std::int64_t part) {
    std::uint32_t* next = places.data() + part * stride;
    auto [begin, end] = part_of(part);
    for (std::int64_t k = begin; k < end; ++k) {
      std::uint32_t nth = ranked[k].first;
      each_bin(ranked[k].range, [&](int bin) {
        const std::uint32_t at = next[bin]++;
        out.pairs[at] = ranked[k].splat;
        out.where[nth++] = at;
      });
    }
  });
}

}  // namespace clear
