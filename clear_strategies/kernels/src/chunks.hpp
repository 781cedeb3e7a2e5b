// How passes over the Gaussians are cut: chunks of them, one task each, and sixteen Gaussians at a time; and how the row of
// shN of a Gaussian lies in vectors.
#pragma once

#include <algorithm>
#include <cstdint>

#include "simd.hpp"

namespace clear {

inline constexpr std::int64_t kChunk = 1024;  // Gaussians per task, a multiple of sixteen

inline std::int64_t chunks(std::int64_t n) { return (n + kChunk - 1) / kChunk; }

CLEAR_INLINE std::uint32_t first_bits(int count) { return count == kLanes ? 0xffffu : (1u << count) - 1; }

// Calls task(i, count) for every sixteen Gaussians of chunk `number`.
template <class Task>
CLEAR_INLINE void each_sixteen(std::int64_t n, std::int64_t number, Task&& task) {
  std::int64_t end = std::min(n, (number + 1) * kChunk);
  for (std::int64_t i = number * kChunk; i < end; i += kLanes) task(i, int(std::min<std::int64_t>(kLanes, end - i)));
}

// The channel and band of each number of an shN row, in up to three groups of sixteen. The last group ends with the row
// and overlaps the previous one; all are read before any is written, so the overlap is written twice with the same values.
struct RowPlan {
  int sixteens, width, offset[3];
  std::int32_t channel[3][kLanes], band[3][kLanes];

  explicit RowPlan(int width) : sixteens((width + kLanes - 1) / kLanes), width(width) {
    for (int k = 0; k < sixteens; ++k) {
      offset[k] = std::max(0, std::min(kLanes * k, width - kLanes));
      for (int j = 0; j < kLanes; ++j) {
        channel[k][j] = (offset[k] + j) % 3;
        band[k][j] = std::min((offset[k] + j) / 3 + 1, kLanes - 1);  // the basis is 0 for inactive bands
      }
    }
  }
};

}  // namespace clear
