// Bin, first half: sorts the visible Gaussians front to back. Only these are sorted, never (tile, Gaussian) pairs.
#pragma once

#include <bit>

#include "pool.hpp"
#include "types.hpp"

namespace clear {

// A depth and its Gaussian. Positive floats order like their bits; ties keep the index order (stable sorts).
struct DepthKey {
  std::uint32_t depth, index;
};

// Radix sort, least significant digit first; each digit is a stable counting sort, parallel over chunks.
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

// Indices of the Gaussians for which `shows(i)`, by depth, then index.
template <class T, class Shows>
void order_by_depth(std::int64_t n, Shows&& shows, const Buffer<double>& depths, Buffer<std::uint32_t>& order, int threads) {
  const std::int64_t chunk = 8192, chunks = (n + chunk - 1) / chunk;
  struct Extent {
    std::int64_t count = 0;
    std::uint64_t low = UINT64_MAX, high = 0;
  };
  std::vector<Extent> extents(chunks);
  auto each = [&](std::int64_t c, auto&& visit) {
    for (std::int64_t i = c * chunk; i < std::min(n, (c + 1) * chunk); ++i)
      if (shows(i)) visit(i, std::bit_cast<std::uint64_t>(depths[i]));
  };
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    Extent e;
    each(c, [&](std::int64_t, std::uint64_t depth) {
      ++e.count, e.low = std::min(e.low, depth), e.high = std::max(e.high, depth);
    });
    extents[c] = e;
  });
  Extent all;
  std::vector<std::int64_t> starts(chunks);
  for (std::int64_t c = 0; c < chunks; ++c) {
    starts[c] = all.count;
    all = {all.count + extents[c].count, std::min(all.low, extents[c].low), std::max(all.high, extents[c].high)};
  }
  order.reserve_lost(all.count);
  if constexpr (sizeof(T) == 4) {
    // Keys are the 32 bits below the highest bit in which two depths differ: about 30 significant bits, a float has 24.
    const int shift = all.count ? std::max(0, int(std::bit_width(all.high - all.low)) - 32) : 0;
    Buffer<DepthKey> keys, spare;
    keys.reserve_lost(all.count);
    Pool::instance().run(threads, chunks, [&](std::int64_t c) {
      std::int64_t at = starts[c];
      each(c, [&](std::int64_t i, std::uint64_t depth) {
        keys[at++] = {std::uint32_t((depth - all.low) >> shift), std::uint32_t(i)};
      });
    });
    sort_by_depth(keys, spare, threads);
    for (std::int64_t i = 0; i < all.count; ++i) order[i] = keys[i].index;
  } else {
    std::int64_t at = 0;
    for (std::int64_t c = 0; c < chunks; ++c) each(c, [&](std::int64_t i, std::uint64_t) { order[at++] = std::uint32_t(i); });
    std::stable_sort(order.data(), order.data() + all.count, [&](auto a, auto b) { return depths[a] < depths[b]; });
  }
}

}  // namespace clear
