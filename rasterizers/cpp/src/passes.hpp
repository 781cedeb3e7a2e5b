// The forward and the backward pass of one bin over its blocks. Each is one task of the pool.
#pragma once

#include "blend.hpp"

namespace clear {

// One bin of a band.
template <class T>
struct BinJob {
  const Settings<T>& settings;
  const Grid<T>& grid;
  const Buffer<Ellipse<T>>& ellipses;
  Bins& bins;
  int bin, x, y;                 // its index in the band, and its place on the pixel grid
  std::uint64_t inside;          // blocks in the image
  BlockEnd<T>* ends;             // [64]

  std::int64_t pairs() const { return bins.starts[bin + 1] - bins.starts[bin]; }
  int block_x(int block) const { return x * kBin + block % kBlocksAcross * kBlock; }
  int block_y(int block) const { return y * kBin + block / kBlocksAcross * kBlock; }
};

template <class T>
Segment<T>& thread_segment() {
  static thread_local Segment<T> segment;
  return segment;
}

// Draws the bin's pixels into an image [height, width, 3] and alpha and depth [height, width]; depth is null for C = kColour.
template <class T, int C>
void draw_bin(const BinJob<T>& job, T* image, T* alpha, T* depth) {
  using L = Lanes<T>;
  static thread_local BlockBlend<T, C> scratch[kBlocks];
  BlockBlend<T, C>* blends = scratch;
  each_bit(job.inside, [&](int b) {
    std::fill_n(job.ends[b].transmittance, kLanes, T(1));
    std::fill_n(job.ends[b].ended, kLanes, INT_MAX);
    blends[b] = {};
  });
  const std::int64_t n = job.pairs();
  std::uint64_t open = job.inside;
  for (std::int64_t first = 0; first < n && open; first += kSegment) {
    Segment<T>& part = thread_segment<T>();
    gather(job.ellipses, job.bins, job.bin, first, job.inside, part);
    each_bit(open, [&](int b) {
      if (!part.lengths[b]) return;
      blend_block(part, b, job.settings, blends[b], job.ends[b]);
      if (first + kSegment < n && job.ends[b].finished()) open &= ~(std::uint64_t(1) << b);
    });
  }
  each_bit(job.inside, [&](int b) {
    const L through = L::load(job.ends[b].transmittance);
    L pixel[3], cover[1] = {L(T(1)) - through};
    for (int c = 0; c < 3; ++c) pixel[c] = L::load(blends[b].sums[c]) + through * L(job.settings.background[c]);
    store_block<3>(image, job.grid.width, job.grid.height, job.block_x(b), job.block_y(b), pixel);
    store_block<1>(alpha, job.grid.width, job.grid.height, job.block_x(b), job.block_y(b), cover);
    if constexpr (C == kColourAndDepth) {
      const L weight = L::load(blends[b].sums[kColourAndDepth]);  // 0 where nothing is drawn
      const L expected[1] = {L::load(blends[b].sums[kColour]) * where(weight > L(T(0)), L(T(1)) / weight)};
      store_block<1>(depth, job.grid.width, job.grid.height, job.block_x(b), job.block_y(b), expected);
    }
  });
}

// The state of a bin's blocks in the backward pass.
template <class T, int K, int C>
struct BinVjp {
  BlockBack<T, K> back[kBlocks];
  T cotangent[kBlocks][K][C][kLanes];
};

template <class T, int K, int C>
void start_vjp(const BinJob<T>& job, const Cotangents<T>& cotangents, BinVjp<T, K, C>& out) {
  using L = Lanes<T>;
  const int width = job.grid.width, height = job.grid.height;
  const std::int64_t pixels = std::int64_t(width) * height;
  each_bit(job.inside, [&](int b) {
    const int X = job.block_x(b), Y = job.block_y(b);
    const L through = L::load(job.ends[b].transmittance);
    through.store(out.back[b].transmittance);
    for (int k = 0; k < K; ++k) {
      L v[kColour], one[1], light = T(0);
      load_block<kColour>(cotangents.image + k * pixels * kColour, width, height, X, Y, v);
      for (int c = 0; c < kColour; ++c) light += v[c] * L(job.settings.background[c]);
      for (int c = 0; c < kColour; ++c) v[c].store(out.cotangent[b][k][c]);
      if constexpr (C == kColourAndDepth) {
        load_block<1>(cotangents.depth + k * pixels, width, height, X, Y, one);
        one[0].store(out.cotangent[b][k][kColour]);
      }
      if (cotangents.alpha) {
        load_block<1>(cotangents.alpha + k * pixels, width, height, X, Y, one);
        light -= one[0];
      }
      (through * light).store(out.back[b].behind[k]);
    }
  });
}

// Prefetches a bin's cotangents, whose rows lie far apart in memory, while its Gaussians are gathered.
template <class T, int K>
CLEAR_INLINE void fetch_cotangents(const BinJob<T>& job, const T* images) {
  const std::int64_t image = std::int64_t(job.grid.width) * job.grid.height * kColour;
  for (int k = 0; k < K; ++k)
    for (int y = job.y * kBin; y < std::min(job.grid.height, (job.y + 1) * kBin); ++y)
      for (int x = 0; x < kColour * kBin; x += kLanes)
        __builtin_prefetch(images + k * image + (std::int64_t(y) * job.grid.width + job.x * kBin) * kColour + x);
}

// The backward pass of a bin, back to front. Writes the sums of all its pairs.
template <class T, int K, int C, bool Absolute>
void blend_vjp_bin(const BinJob<T>& job, const Cotangents<T>& cotangents, PairSums<T, K, C, Absolute>* pair_sums) {
  const std::int64_t n = job.pairs();
  if (!n) return;
  static thread_local BinVjp<T, K, C> scratch;
  BinVjp<T, K, C>& mine = scratch;
  fetch_cotangents<T, K>(job, cotangents.image);
  std::int64_t end = 0;  // no pixel blended a pair from here on, and their segments may not have been listed
  each_bit(job.inside, [&](int b) {
    for (std::int32_t e : job.ends[b].ended) end = std::max<std::int64_t>(end, std::min<std::int64_t>(e, n));
  });
  bool started = false;
  for (std::int64_t first = (n - 1) / kSegment * kSegment; first >= 0; first -= kSegment) {
    const std::int64_t count = std::min<std::int64_t>(kSegment, n - first);
    PairSums<T, K, C, Absolute>* sums = pair_sums + job.bins.starts[job.bin] + first;
    std::memset(static_cast<void*>(sums), 0, sizeof *sums * count);
    if (first >= end) continue;
    Segment<T>& part = thread_segment<T>();
    gather(job.ellipses, job.bins, job.bin, first, job.inside, part);
    if (!std::exchange(started, true)) start_vjp(job, cotangents, mine);
    each_bit(job.inside, [&](int b) {
      if (part.lengths[b]) blend_block_vjp<T, K, C, Absolute>(part, b, job.settings, job.ends[b], mine.cotangent[b], mine.back[b], sums);
    });
  }
}

}  // namespace clear
