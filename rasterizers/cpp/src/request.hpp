// The tile mask: which blocks of which bins are drawn, and how many requested bins lie in a rectangle.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <vector>

#include "types.hpp"

namespace clear {

// A rectangle of bins, both ends included; empty if x1 = x0 - 1 or y1 = y0 - 1.
struct BinRange {
  std::int16_t x0 = 0, x1 = -1, y0 = 0, y1 = -1;
  std::int64_t count() const { return std::int64_t(x1 + 1 - x0) * std::int64_t(y1 + 1 - y0); }
};

class Request {
 public:
  Request() = default;  // every block

  // Requests the blocks of the tiles that are set; tiles have `edge` px, a multiple of 4.
  Request(const bool* tiles, int edge, int width, int height)
      : columns_((width + kBin - 1) / kBin), rows_((height + kBin - 1) / kBin), blocks_(std::size_t(columns_) * rows_, 0) {
    const int across = (width + edge - 1) / edge;
    for (int y = 0; y * kBlock < height; ++y)
      for (int x = 0; x * kBlock < width; ++x)
        if (tiles[y * kBlock / edge * across + x * kBlock / edge])
          blocks_[y / kBlocksAcross * columns_ + x / kBlocksAcross] |=
              std::uint64_t(1) << (y % kBlocksAcross * kBlocksAcross + x % kBlocksAcross);
    near_.assign(blocks_.size(), 0);
    for (int y = rows_; y-- > 0;) {
      std::uint64_t row = 0;
      for (int x = columns_; x-- > 0;) {
        row = (row << 1 | (blocks_[y * columns_ + x] != 0)) & 0xff;
        near_[y * columns_ + x] = row | (y + 1 < rows_ ? near_[(y + 1) * columns_ + x] << kPatch : 0);
      }
    }
  }

  bool all() const { return blocks_.empty(); }
  // One bit per block of a bin, counted row by row.
  std::uint64_t blocks(std::int64_t bin) const { return all() ? ~std::uint64_t(0) : blocks_[bin]; }
  // How many bins of the rectangle have a requested block.
  std::int64_t bins_in(const BinRange& r) const {
    if (all()) return r.count();
    std::int64_t count = 0;
    each_patch(r, [&](int, int, std::uint64_t bits) { count += std::popcount(bits); });
    return count;
  }

  // Calls visit(x, y) for each such bin, row by row.
  template <class Visit>
  void each_bin(const BinRange& r, Visit&& visit) const {
    if (all()) {  // one loop, because the ends of two are harder for a processor to foresee
      std::int64_t left = r.count();
      for (int x = r.x0, y = r.y0; left; --left) {
        visit(x, y);
        const bool last = x == r.x1;
        x = last ? r.x0 : x + 1, y += last;
      }
      return;
    }
    each_patch(r, [&](int x, int y, std::uint64_t bits) {
      each_bit(bits, [&](int i) CLEAR_LAMBDA { visit(x + i % kPatch, y + i / kPatch); });
    });
  }

 private:
  static constexpr int kPatch = 8;  // edge of a patch, bins: a 64-bit word has a bit per bin of a patch

  // Calls visit(x, y, bits) for the patches that make up the rectangle: squares, or rows if it is too wide.
  template <class Visit>
  void each_patch(const BinRange& r, Visit&& visit) const {
    if (std::max(r.x1 - r.x0, r.y1 - r.y0) < kPatch) return visit(r.x0, r.y0, patch(r, r.x0, r.y0, kPatch));  // nearly always
    const int rows = r.x1 - r.x0 < kPatch ? kPatch : 1;
    for (int y = r.y0; y <= r.y1; y += rows)
      for (int x = r.x0; x <= r.x1; x += kPatch) visit(x, y, patch(r, x, y, rows));
  }

  // The requested bins of the rectangle in the patch from (x, y) on, at most `rows` high.
  std::uint64_t patch(const BinRange& r, int x, int y, int rows) const {
    return near_[y * columns_ + x] & rectangle(std::min(r.x1 + 1 - x, kPatch), std::min(r.y1 + 1 - y, rows));
  }

  // The bits of the upper left width x height bins of a patch.
  static std::uint64_t rectangle(int width, int height) {
    static constexpr std::uint64_t kRows[] = {0x0,          0x1,            0x101,            0x10101,           0x1010101,
                                              0x101010101, 0x10101010101, 0x1010101010101, 0x101010101010101};
    return ((1u << width) - 1) * kRows[height];
  }

  int columns_ = 0, rows_ = 0;
  std::vector<std::uint64_t> blocks_;  // by bin; empty: all
  std::vector<std::uint64_t> near_;    // by bin: which bins of the patch from it on have a requested block
};

}  // namespace clear
