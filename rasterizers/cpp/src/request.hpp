// The tile mask: which blocks of which bins are drawn, and how many requested bins lie in a rectangle.
#pragma once

#include <cstdint>
#include <vector>

#include "types.hpp"

namespace clear {

// A rectangle of bins, both ends included; empty if x1 = x0 - 1 or y1 = y0 - 1.
struct BinRange {
  std::int16_t x0 = 0, x1 = -1, y0 = 0, y1 = -1;
  std::int64_t count() const { return x1 < x0 || y1 < y0 ? 0 : std::int64_t(x1 - x0 + 1) * (y1 - y0 + 1); }
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
    requested_.assign(std::size_t(rows_) * words() + 1, 0);
    before_.assign(std::size_t(columns_ + 1) * (rows_ + 1), 0);
    for (int y = 0; y < rows_; ++y)
      for (int x = 0, row = 0; x < columns_; ++x) {
        const bool any = blocks_[y * columns_ + x] != 0;
        requested_[y * words() + x / 64] |= std::uint64_t(any) << x % 64;
        row += any;
        before_[corner(x + 1, y + 1)] = before_[corner(x + 1, y)] + row;
      }
  }

  bool all() const { return blocks_.empty(); }
  // One bit per block of a bin, counted row by row.
  std::uint64_t blocks(std::int64_t bin) const { return all() ? ~std::uint64_t(0) : blocks_[bin]; }
  // The bins of the rectangle with a requested block. No branches: which Gaussians have any is not predictable.
  std::int64_t bins_in(const BinRange& r) const {
    if (all()) return r.count();
    return before_[corner(r.x1 + 1, r.y1 + 1)] - before_[corner(r.x0, r.y1 + 1)] - before_[corner(r.x1 + 1, r.y0)] +
           before_[corner(r.x0, r.y0)];
  }

  // Calls visit(x, y) for each bin of the rectangle with a requested block, row by row.
  template <class Visit>
  void each_bin(const BinRange& r, Visit&& visit) const {
    for (int y = r.y0; y <= r.y1; ++y) {
      if (all())
        for (int x = r.x0; x <= r.x1; ++x) visit(x, y);
      else
        for (int x = r.x0; x <= r.x1; x += 64)
          for (std::uint64_t bits = bins_from(x, y, r.x1 - x + 1); bits; bits &= bits - 1) visit(x + __builtin_ctzll(bits), y);
    }
  }

 private:
  std::size_t corner(int x, int y) const { return std::size_t(y) * (columns_ + 1) + x; }

  int words() const { return (columns_ + 63) / 64; }
  // Up to 64 bins of a row from x on, as bits.
  std::uint64_t bins_from(int x, int y, int count) const {
    const std::uint64_t* row = requested_.data() + y * words() + x / 64;
    const std::uint64_t bits = x % 64 ? row[0] >> x % 64 | row[1] << (64 - x % 64) : row[0];
    return count < 64 ? bits & ((std::uint64_t(1) << count) - 1) : bits;
  }

  int columns_ = 0, rows_ = 0;
  std::vector<std::uint64_t> blocks_;  // by bin; empty: all
  std::vector<std::uint64_t> requested_;  // one bit per bin, each row from a word of its own on, and a word more
  std::vector<std::int32_t> before_;   // requested bins above and to the left of each corner
};

}  // namespace clear
