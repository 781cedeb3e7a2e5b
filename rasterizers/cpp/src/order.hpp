// Bin, first half: the Gaussians that show, front to back. Only these few numbers are sorted, never (tile, Gaussian) pairs.
#pragma once

#include <bit>

#include "pool.hpp"
#include "types.hpp"

namespace clear {

// A depth and whose it is. Positive floats order like their bits; ties keep the order of the indices (stable sorts).
struct DepthKey {
  std::uint32_t depth, index;
};

// Least significant digit first, every digit a stable counting sort in parallel over chunks.
inline void sort_by_depth(Buffer<DepthKey>& keys, Buffer<DepthKey>& spare, int threads) {
  const std::int64_t n = std::int64_t(keys.size());
  if (n < 2) return;
  std::uint32_t low = UINT32_MAX, high = 0;
  for (std::int64_t i = 0; i < n; ++i) low = std::min(low, keys[i].depth), high = std::max(high, keys[i].depth);
  const int bits = std::bit_width(high - low);
  if (!bits) return;
  const int passes = (bits + 10) / 11, digit = (bits + passes - 1) / passes, buckets = 1 << digit;
  const int chunks = n < 16384 ? 1 : std::max(1, threads);
  std::vector<std::uint32_t> places(std::size_t(chunks) * buckets);
  spare.reserve_lost(n);
  for (int pass = 0; pass < passes; ++pass) {
    const int shift = pass * digit;
    auto bucket = [&](const DepthKey& k) { return ((k.depth - low) >> shift) & (buckets - 1); };
    auto range = [&](std::int64_t chunk) { return std::pair(n * chunk / chunks, n * (chunk + 1) / chunks); };
    Pool::instance().run(threads, chunks, [&](std::int64_t chunk) {
      std::uint32_t* counts = places.data() + chunk * buckets;
      std::fill(counts, counts + buckets, 0);
      auto [begin, end] = range(chunk);
      for (std::int64_t i = begin; i < end; ++i) ++counts[bucket(keys[i])];
    });
    std::uint32_t place = 0;
    for (int b = 0; b < buckets; ++b)
      for (int chunk = 0; chunk < chunks; ++chunk)
        place += std::exchange(places[std::size_t(chunk) * buckets + b], place);
    Pool::instance().run(threads, chunks, [&](std::int64_t chunk) {
      std::uint32_t* next = places.data() + chunk * buckets;
      auto [begin, end] = range(chunk);
      for (std::int64_t i = begin; i < end; ++i) spare[next[bucket(keys[i])]++] = keys[i];
    });
    std::swap(keys, spare);
  }
}

// Indices of the Gaussians for which `shows(i)`, by depth(i), then index.
template <class T, class Shows, class Depth>
void order_by_depth(std::int64_t n, Shows&& shows, Depth&& depth, Buffer<std::uint32_t>& order, int threads) {
  const std::int64_t chunk = 8192, chunks = (n + chunk - 1) / chunk;
  std::vector<std::int64_t> starts(chunks + 1, 0);
  auto each = [&](std::int64_t c, auto&& visit) {
    for (std::int64_t i = c * chunk; i < std::min(n, (c + 1) * chunk); ++i)
      if (shows(i)) visit(i);
  };
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    std::int64_t count = 0;
    each(c, [&](std::int64_t) { ++count; });
    starts[c + 1] = count;
  });
  for (std::int64_t c = 0; c < chunks; ++c) starts[c + 1] += starts[c];
  const std::int64_t m = starts[chunks];
  order.reserve_lost(m);
  if constexpr (sizeof(T) == 4) {
    Buffer<DepthKey> keys, spare;
    keys.reserve_lost(m);
    Pool::instance().run(threads, chunks, [&](std::int64_t c) {
      std::int64_t at = starts[c];
      each(c, [&](std::int64_t i) { keys[at++] = {std::bit_cast<std::uint32_t>(depth(i)), std::uint32_t(i)}; });
    });
    sort_by_depth(keys, spare, threads);
    for (std::int64_t i = 0; i < m; ++i) order[i] = keys[i].index;
  } else {
    std::int64_t at = 0;
    for (std::int64_t c = 0; c < chunks; ++c) each(c, [&](std::int64_t i) { order[at++] = std::uint32_t(i); });
    std::stable_sort(order.data(), order.data() + m, [&](auto a, auto b) { return depth(a) < depth(b); });
  }
}

}  // namespace clear
