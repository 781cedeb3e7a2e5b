// Compiled with -ffp-contract=off: sums and products round as in torch.
#include "sweep.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "pool.hpp"

namespace clear {
namespace {

constexpr int kBand = 32;  // rows of a task; what it draws stays in the L2 cache

// a · b + c, rounded once where the processor has FMA, as in torch's grid_sample.
inline float multiply_add(float a, float b, float c) {
#if defined(__FMA__)
  return __builtin_fmaf(a, b, c);
#else
  return a * b + c;
#endif
}

// A coordinate of `size` pixels from grid_sample's, whose -1 and 1 are the outer borders; the border is repeated. NaN gives 0.
inline float pixel(float at, int size) {
  const float p = multiply_add(at + 1.0f, float(size) / 2.0f, -0.5f), most = float(size - 1);
  return p > 0.0f ? (p < most ? p : most) : 0.0f;
}

// A row of the other photo, drawn through a plane, and how far from its middle each pixel lies: inside it, less than 1.
void draw(const Sweep& s, float inverse_depth, int row, float* __restrict drawn, float* __restrict reach) {
  const std::ptrdiff_t plane = std::ptrdiff_t(s.height) * s.width;
  const float *X = s.rotated + std::ptrdiff_t(row) * s.width, *Y = X + plane, *Z = Y + plane;
  const float dx = s.shift[0] * inverse_depth, dy = s.shift[1] * inverse_depth, dz = s.shift[2] * inverse_depth;
  const int width = s.other_width, height = s.other_height, n = s.width;
  const float half_width = float(width) / 2.0f, half_height = float(height) / 2.0f;
  const float* __restrict other = s.other;
#pragma GCC ivdep
  for (int i = 0; i < n; ++i) {
    const float z = Z[i] + dz, u = (X[i] + dx) / (z * half_width) - 1.0f, v = (Y[i] + dy) / (z * half_height) - 1.0f;
    reach[i] = z > 0.0f ? std::max(std::fabs(u), std::fabs(v)) : 1.0f;
    const float x = pixel(u, width), y = pixel(v, height);
    const int left = int(x), top = int(y), right = std::min(left + 1, width - 1), bottom = std::min(top + 1, height - 1);
    const float w = x - float(left), e = 1.0f - w, below = y - float(top), above = 1.0f - below;
    const float upper = multiply_add(other[top * width + right], w * above, other[top * width + left] * (e * above));
    drawn[i] = multiply_add(other[bottom * width + right], w * below,
                            multiply_add(other[bottom * width + left], e * below, upper));
  }
}

// The mean over the windows along a row: `sums` are those down its columns, with `radius` free numbers at both sides.
void mean_along(float* __restrict sums, int width, int window, float* __restrict means) {
  const int radius = window / 2;
  std::fill(sums, sums + radius, sums[radius]);
  std::fill(sums + radius + width, sums + 2 * radius + width, sums[radius + width - 1]);
  const float share = float(1.0 / (window * window));
  std::copy_n(sums, width, means);
  for (int k = 1; k < window; ++k)
    for (int i = 0; i < width; ++i) means[i] += sums[i + k];
  for (int i = 0; i < width; ++i) means[i] *= share;
}

void sweep_band(const Sweep& s, float inverse_depth, int first, int last, float* __restrict covariances,
                float* __restrict variances) {
  const int radius = s.window / 2, rows = last - first + 2 * radius, W = s.width, padded = W + 2 * radius;
  static thread_local std::vector<float> memory;
  memory.resize(std::size_t(2 * rows) * W + 3 * padded + 3 * W);
  float *drawn = memory.data(), *reaches = drawn + rows * W, *d = reaches + rows * W, *dd = d + padded, *ad = dd + padded;
  float *mean = ad + padded, *square = mean + W, *product = square + W;
  auto clamped = [&](int row) { return std::clamp(row, 0, s.height - 1); };
  for (int k = 0; k < rows; ++k) draw(s, inverse_depth, clamped(first - radius + k), drawn + k * W, reaches + k * W);
  for (int y = first; y < last; ++y) {
    for (int k = 0; k < s.window; ++k) {
      const float* __restrict b = drawn + (y - first + k) * W;
      const float* __restrict a = s.image + std::ptrdiff_t(clamped(y - radius + k)) * W;
      float *__restrict d_ = d + radius, *__restrict dd_ = dd + radius, *__restrict ad_ = ad + radius;
      if (k == 0)
        for (int i = 0; i < W; ++i) d_[i] = b[i], dd_[i] = b[i] * b[i], ad_[i] = a[i] * b[i];
      else
        for (int i = 0; i < W; ++i) d_[i] += b[i], dd_[i] += b[i] * b[i], ad_[i] += a[i] * b[i];
    }
    mean_along(d, W, s.window, mean), mean_along(dd, W, s.window, square), mean_along(ad, W, s.window, product);
    const std::ptrdiff_t at = std::ptrdiff_t(y) * W;
    const float *reach = reaches + (y - first + radius) * W, *m = s.mean + at;
    for (int i = 0; i < W; ++i) {
      const float covariance = product[i] - m[i] * mean[i];
      variances[at + i] = square[i] - mean[i] * mean[i];
      covariances[at + i] = reach[i] < 1.0f ? covariance : 0.0f;
    }
  }
}

}  // namespace

void sweep(const Sweep& s, const float* inverse_depths, int planes, float* covariances, float* variances, int threads) {
  const std::int64_t bands = (s.height + kBand - 1) / kBand, plane = std::int64_t(s.height) * s.width;
  Pool::instance().run(threads, planes * bands, [&](std::int64_t task) {
    const int p = int(task / bands), first = int(task % bands) * kBand;
    sweep_band(s, inverse_depths[p], first, std::min(first + kBand, s.height), covariances + p * plane,
               variances + p * plane);
  });
}

}  // namespace clear
