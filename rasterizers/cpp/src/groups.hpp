// Lists of Gaussians that are processed sixteen at a time, so that work on few of them does not scale with all.
#pragma once

#include <algorithm>
#include <vector>

#include "types.hpp"

namespace clear {

// The Gaussians of one task of the pool: small enough that what one stage writes is in the cache for the next.
inline constexpr std::int64_t kChunk = 64 * kLanes;

inline std::int64_t chunks_of(std::int64_t n) { return (n + kChunk - 1) / kChunk; }
inline std::int64_t groups_of(std::int64_t n) { return (n + kLanes - 1) / kLanes; }

// Up to sixteen Gaussians, ascending. Lanes beyond `count` repeat the last one.
struct Group {
  std::uint32_t rows[kLanes];
  int count;
  bool consecutive;  // their rows are contiguous in memory

  Group(const std::uint32_t* first, std::int64_t left) : count(int(std::min<std::int64_t>(kLanes, left))) {
    for (int i = 0; i < kLanes; ++i) rows[i] = first[std::min(i, count - 1)];
    consecutive = rows[count - 1] - rows[0] == std::uint32_t(count - 1);
  }
};

// The Gaussians that some grid draws. By chunk, ascending.
class Drawn {
 public:
  void reserve(std::int64_t n) {
    numbers_.reserve_lost(std::size_t(chunks_of(n)) * kChunk);
    counts_.assign(chunks_of(n), 0);
  }
  std::int64_t chunks() const { return std::int64_t(counts_.size()); }
  // Where the chunk's numbers are written; `close` sets their count.
  std::uint32_t* open(std::int64_t chunk) { return numbers_.data() + chunk * kChunk; }
  void close(std::int64_t chunk, std::int64_t count) { counts_[chunk] = count; }
  const std::uint32_t* begin(std::int64_t chunk) const { return numbers_.data() + chunk * kChunk; }
  const std::uint32_t* end(std::int64_t chunk) const { return begin(chunk) + counts_[chunk]; }

 private:
  Buffer<std::uint32_t> numbers_;  // [chunks, kChunk]
  std::vector<std::int64_t> counts_;
};

}  // namespace clear
