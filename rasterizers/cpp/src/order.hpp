// Bin, first half: sorts the drawn Gaussians front to back. Only these are sorted, never (tile, Gaussian) pairs.
#pragma once

#include <bit>

#include "groups.hpp"
#include "pool.hpp"

namespace clear {

// A depth and its Gaussian. Positive floats order like their bits; ties keep the index order (stable sorts).
struct DepthKey {
  std::uint32_t depth, index;
};

// Writes the Gaussians of keys up to `high` by depth. Radix sort, least significant digit first; each digit is a stable
// counting sort, parallel over chunks.
inline void sort_by_depth(Buffer<DepthKey>& keys, std::uint32_t high, Buffer<std::uint32_t>& order, int threads) {
  const std::int64_t n = std::int64_t(keys.size());
  const int bits = std::max(1, int(std::bit_width(high)));
  const int passes = (bits + 10) / 11, digit = (bits + passes - 1) / passes, buckets = 1 << digit;
  const int chunks = n < 16384 ? 1 : std::max(1, threads);
  std::vector<std::uint32_t> places(std::size_t(chunks) * buckets);
  Buffer<DepthKey> spare;
  spare.reserve_lost(passes > 1 ? n : 0);
  for (int pass = 0; pass < passes; ++pass) {
    const int shift = pass * digit;
    auto bucket = [&](const DepthKey& k) { return (k.depth >> shift) & (buckets - 1); };
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
      if (pass + 1 < passes)
        for (std::int64_t i = begin; i < end; ++i) spare[next[bucket(keys[i])]++] = keys[i];
      else
        for (std::int64_t i = begin; i < end; ++i) order[next[bucket(keys[i])]++] = keys[i].index;
    });
    std::swap(keys, spare);
  }
}

// The drawn Gaussians by depth, then index.
template <class T>
void order_by_depth(const Drawn& drawn, const Buffer<double>& depths, Buffer<std::uint32_t>& order, int threads) {
  const std::int64_t chunks = drawn.chunks();
  struct Extent {
    std::uint64_t low = UINT64_MAX, high = 0;
  };
  auto bits = [&](std::uint32_t i) { return std::bit_cast<std::uint64_t>(depths[i]); };
  std::vector<Extent> extents(chunks);
  Pool::instance().run(threads, chunks, [&](std::int64_t c) {
    Extent e;
    for (const std::uint32_t* i = drawn.begin(c); i < drawn.end(c); ++i)
      e.low = std::min(e.low, bits(*i)), e.high = std::max(e.high, bits(*i));
    extents[c] = e;
  });
  Extent all;
  std::int64_t count = 0;
  std::vector<std::int64_t> starts(chunks);
  for (std::int64_t c = 0; c < chunks; ++c) {
    starts[c] = count, count += drawn.end(c) - drawn.begin(c);
    all = {std::min(all.low, extents[c].low), std::max(all.high, extents[c].high)};
  }
  order.reserve_lost(count);
  if constexpr (sizeof(T) == 4) {
    // Keys are the 32 bits below the highest bit in which two depths differ: about 30 significant bits, a float has 24.
    const int shift = count ? std::max(0, int(std::bit_width(all.high - all.low)) - 32) : 0;
    Buffer<DepthKey> keys;
    keys.reserve_lost(count);
    Pool::instance().run(threads, chunks, [&](std::int64_t c) {
      std::int64_t at = starts[c];
      for (const std::uint32_t* i = drawn.begin(c); i < drawn.end(c); ++i)
        keys[at++] = {std::uint32_t((bits(*i) - all.low) >> shift), *i};
    });
    sort_by_depth(keys, std::uint32_t((all.high - all.low) >> shift), order, threads);
  } else {
    for (std::int64_t c = 0; c < chunks; ++c) std::copy(drawn.begin(c), drawn.end(c), order.data() + starts[c]);
    std::stable_sort(order.data(), order.data() + count, [&](auto a, auto b) { return depths[a] < depths[b]; });
  }
}

}  // namespace clear
