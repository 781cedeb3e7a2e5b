// Blend, bin by bin: a bin's blocks forward to pixels, and back to what its Gaussians get. One task of the pool each.
#pragma once

#include "blend.hpp"

namespace clear {

// One bin of a band.
template <class T>
struct BinJob {
  const Settings<T>& settings;
  const Screen<T>& screen;
  const Buffer<Ellipse<T>>& ellipses;
  Bins& bins;
  int bin, x, y;                 // which of the band, and where on the screen
  std::uint64_t inside, wanted;  // blocks in the image; those of them that were asked for
  BlockEnd<T>* ends;             // [64]

  std::int64_t pairs() const { return bins.starts[bin + 1] - bins.starts[bin]; }
  int block_x(int block) const { return x * kBin + block % kBlocksAcross * kBlock; }
  int block_y(int block) const { return y * kBin + block / kBlocksAcross * kBlock; }
};

template <class Visit>
CLEAR_INLINE void each_block(std::uint64_t blocks, Visit&& visit) {
  for (; blocks; blocks &= blocks - 1) visit(__builtin_ctzll(blocks));
}

template <class T>
Segment<T>& my_segment() {
  static thread_local Segment<T> segment;
  return segment;
}

// Draw the bin's pixels into [height, width, 3] and [height, width]; blocks not asked for show the background.
template <class T>
void draw_bin(const BinJob<T>& job, T* image, T* alpha) {
  using L = Lanes<T>;
  static thread_local BlockColour<T> scratch[kBlocks];
  BlockColour<T>* colours = scratch;
  each_block(job.inside, [&](int b) {
    std::fill_n(job.ends[b].transmittance, kLanes, T(1));
    std::fill_n(job.ends[b].ended, kLanes, INT_MAX);
    colours[b] = {};
  });
  const std::int64_t n = job.pairs();
  std::uint64_t open = job.wanted;
  for (std::int64_t first = 0; first < n && open; first += kSegment) {
    Segment<T>& part = my_segment<T>();
    gather(job.ellipses, job.bins, job.bin, first, job.wanted, part);
    each_block(open, [&](int b) {
      if (!part.lengths[b]) return;
      blend_block(part, b, job.settings, colours[b], job.ends[b]);
      if (first + kSegment < n && job.ends[b].finished()) open &= ~(std::uint64_t(1) << b);
    });
  }
  each_block(job.inside, [&](int b) {
    const L through = L::load(job.ends[b].transmittance);
    const L channels[3] = {L::load(colours[b].r), L::load(colours[b].g), L::load(colours[b].b)};
    L pixel[3], cover[1] = {L(T(1)) - through};
    for (int c = 0; c < 3; ++c) pixel[c] = channels[c] + through * L(job.settings.background[c]);
    store_block<3>(image, job.screen.width, job.screen.height, job.block_x(b), job.block_y(b), pixel);
    store_block<1>(alpha, job.screen.width, job.screen.height, job.block_x(b), job.block_y(b), cover);
  });
}

// What a bin's blocks start the way back with.
template <class T, int K>
struct Entrance {
  BlockBack<T, K> back[kBlocks];
  T cotangent[kBlocks][K][3][kLanes];
};

template <class T, int K>
void enter(const BinJob<T>& job, const T* cotangents, Entrance<T, K>& out) {
  using L = Lanes<T>;
  const std::int64_t image = std::int64_t(job.screen.width) * job.screen.height * 3;
  each_block(job.wanted, [&](int b) {
    const L through = L::load(job.ends[b].transmittance);
    through.store(out.back[b].transmittance);
    for (int k = 0; k < K; ++k) {
      L v[3], light = T(0);
      load_block<3>(cotangents + k * image, job.screen.width, job.screen.height, job.block_x(b), job.block_y(b), v);
      for (int c = 0; c < 3; ++c) {
        light += v[c] * L(job.settings.background[c]);
        v[c].store(out.cotangent[b][k][c]);
      }
      (through * light).store(out.back[b].behind[k]);
    }
  });
}

// The cotangents of a bin lie in rows far apart: on their way while its Gaussians are gathered.
template <class T, int K>
CLEAR_INLINE void fetch_cotangents(const BinJob<T>& job, const T* cotangents) {
  const std::int64_t image = std::int64_t(job.screen.width) * job.screen.height * 3;
  for (int k = 0; k < K; ++k)
    for (int y = job.y * kBin; y < std::min(job.screen.height, (job.y + 1) * kBin); ++y)
      for (int x = 0; x < 3 * kBin; x += kLanes)
        __builtin_prefetch(cotangents + k * image + (std::int64_t(y) * job.screen.width + job.x * kBin) * 3 + x);
}

// Back to front. What the bin's pairs get goes to `sent` [pairs, K], every one of them written.
template <class T, int K>
void send_bin(const BinJob<T>& job, const T* cotangents, Pulled<T>* sent) {
  const std::int64_t n = job.pairs();
  if (!n) return;
  static thread_local Entrance<T, K> scratch;
  Entrance<T, K>& mine = scratch;
  fetch_cotangents<T, K>(job, cotangents);
  std::int64_t end = 0;  // no pixel took a pair from here on; its segments may not even have been listed
  each_block(job.wanted, [&](int b) {
    for (std::int32_t e : job.ends[b].ended) end = std::max<std::int64_t>(end, std::min<std::int64_t>(e, n));
  });
  bool entered = false;
  for (std::int64_t first = (n - 1) / kSegment * kSegment; first >= 0; first -= kSegment) {
    const std::int64_t count = std::min<std::int64_t>(kSegment, n - first);
    Pulled<T>* sums = sent + (job.bins.starts[job.bin] + first) * K;
    std::memset(static_cast<void*>(sums), 0, sizeof(Pulled<T>) * count * K);
    if (first >= end) continue;
    Segment<T>& part = my_segment<T>();
    gather(job.ellipses, job.bins, job.bin, first, job.wanted, part);
    if (!std::exchange(entered, true)) enter(job, cotangents, mine);
    each_block(job.wanted, [&](int b) {
      if (part.lengths[b])
        blend_block_vjp<T, K>(part, b, job.settings, job.ends[b], mine.cotangent[b], mine.back[b], sums);
    });
  }
}

}  // namespace clear
