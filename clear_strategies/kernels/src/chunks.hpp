// How passes over the Gaussians are cut: chunks of them, one task each, and sixteen Gaussians at a time.
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

}  // namespace clear
