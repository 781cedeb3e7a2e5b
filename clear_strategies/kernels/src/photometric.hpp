// L1 and mean SSIM of an image with their gradient, in one pass over the images.
#pragma once

#include <cmath>
#include <vector>

#include "pool.hpp"
#include "ssim_tile.hpp"

namespace clear {

// L1 alone; no windows.
inline double l1_with_gradient(const ImagePair& im, float weight, int threads) {
  using Floats = Lanes<float>;
  constexpr std::int64_t chunk = 1 << 14;
  std::int64_t n = std::int64_t(im.height) * im.row, chunks = (n + chunk - 1) / chunk;
  std::vector<double> sums(chunks);
  float scale = weight / float(n);
  Pool::instance().run(threads, chunks, [&](std::int64_t index) {
    std::int64_t begin = index * chunk, end = std::min(n, begin + chunk), i = begin;
    Floats zero(0.0f), sum(0.0f), step(scale);
    for (; i + kLanes <= end; i += kLanes) {
      Floats d = Floats::load(im.x + i) - Floats::load(im.y + i);
      sum += absolute(d);
      (where(d > zero, step) - where(d < zero, step)).store(im.gradient + i);
    }
    double all = 0;
    for (const auto& part : sum.r) all += ssim::total(part);
    for (; i < end; ++i) {
      float d = im.x[i] - im.y[i];
      all += std::fabs(d);
      im.gradient[i] = d > 0 ? scale : d < 0 ? -scale : 0.0f;
    }
    sums[index] = all;
  });
  double all = 0;
  for (double v : sums) all += v;
  return all / double(n);
}

// The sums of task(tile) over the tiles of an image without `inset` pixels at each side. Tiles depend only on the image's size,
// and so the sums do not depend on the threads.
template <class Task>
PhotometricMeans sum_tiles(const ImagePair& im, int inset, int threads, Task&& task) {
  const int height = im.height - 2 * inset, row = im.row - 2 * inset * kChannels;
  const int most = std::clamp(height / 4, ssim::kLowTileHeight, ssim::kTileHeight);
  const int down = (height + most - 1) / most, across = ssim::tiles_across(row);
  auto border = [](int inset, int size, int tiles, int i) { return inset + int(std::int64_t(size) * i / tiles); };
  std::vector<PhotometricMeans> sums(std::size_t(across) * down);
  Pool::instance().run(threads, std::int64_t(sums.size()), [&](std::int64_t i) {
    const int x = int(i) % across, y = int(i) / across, left = inset * kChannels;
    sums[i] = task(ssim::Tile{border(inset, height, down, y), border(inset, height, down, y + 1), border(left, row, across, x),
                              border(left, row, across, x + 1)});
  });
  PhotometricMeans all{0, 0};
  for (const PhotometricMeans& part : sums) all.l1 += part.l1, all.dssim += part.dssim;
  return all;
}

// Writes the gradient of l1 · mean |x - y| + dssim · (1 - SSIM) with respect to x; returns both means. With dssim = 0 no
// SSIM is computed, and its mean is 0; without a gradient SSIM alone is, and the mean of L1 is 0. SSIM is that of the windows
// about pixels at least `inset` from the border.
inline PhotometricMeans photometric(const ImagePair& im, PhotometricWeights weights, int inset, int threads) {
  if (weights.dssim == 0 && im.gradient) return {l1_with_gradient(im, weights.l1, threads), 0};
  auto [l1, dssim] = sum_tiles(im, im.gradient ? 0 : inset, threads,
                               [&](const ssim::Tile& tile) { return ssim::TileRun(im, tile, weights, inset).run(); });
  return {l1 / (double(im.height) * im.row), dssim / (double(im.height - 2 * inset) * (im.row - 2 * inset * kChannels))};
}

}  // namespace clear
