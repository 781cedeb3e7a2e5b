// Compiled with -ffp-contract=off: sums and products round as in torch.
#include "sweep.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "block.hpp"
#include "pool.hpp"

namespace clear {
namespace {

constexpr int kBand = 32;   // rows of a task; what it draws stays in the L2 cache
constexpr int kPlanes = 8;  // that are written at once: half a cache line of the volume

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
void draw(const Sweep& s, const Swept& o, float inverse_depth, int row, float* __restrict drawn, float* __restrict reach) {
  const std::ptrdiff_t plane = std::ptrdiff_t(s.height) * s.width;
  const float *X = o.rotated + std::ptrdiff_t(row) * s.width, *Y = X + plane, *Z = Y + plane;
  const float dx = o.shift[0] * inverse_depth, dy = o.shift[1] * inverse_depth, dz = o.shift[2] * inverse_depth;
  const int width = o.width, height = o.height, n = s.width;
  const float half_width = float(width) / 2.0f, half_height = float(height) / 2.0f;
  const float* __restrict other = o.image;
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

// A thread's memory for a band of rows. Rows are whole blocks of lanes; what lies beyond the width is never written to the volume.
struct Band {
  Band(const Sweep& s, int most)
      : radius(s.window / 2), row((s.width + kLanes - 1) / kLanes * kLanes), border(row + 2 * radius), size(kBand * row),
        drawn(std::size_t(kBand + 2 * radius) * row), reaches(drawn.size()), sums(3 * border), lowest(std::size_t(most) * size),
        means(std::size_t(kPlanes) * size) {}

  int radius, row, border, size;
  std::vector<float> drawn, reaches;  // [the rows of the band and its border, row]
  std::vector<float> sums;            // of b, b² and a b down the columns of the windows of a row [3, border]
  std::vector<float> lowest, means;   // of one plane [most, kBand, row], and of those that are written at once
};

// The windows of row y: sums down their columns, with the columns at both ends repeated.
void add_columns(const Sweep& s, int y, const float* drawn, Band& t) {
  float *b = t.sums.data() + t.radius, *bb = b + t.border, *ab = bb + t.border;
  for (int i = 0; i < s.width; i += kLanes) {
    Floats B = 0.0f, BB = 0.0f, AB = 0.0f;
    for (int k = 0; k < s.window; ++k) {
      const float* image = s.image + std::ptrdiff_t(std::clamp(y - t.radius + k, 0, s.height - 1)) * s.width + i;
      const Floats one = Floats::load(drawn + k * t.row + i), product = load_some(image, std::min(kLanes, s.width - i)) * one;
      B += one, BB += one * one, AB += product;
    }
    B.store(b + i), BB.store(bb + i), AB.store(ab + i);
  }
  for (float* line : {b, bb, ab}) {
    std::fill_n(line - t.radius, t.radius, line[0]);
    std::fill_n(line + s.width, t.radius, line[s.width - 1]);
  }
}

// The mean over the windows of lanes i …, from the sums down their columns.
CLEAR_INLINE Floats window_mean(const float* sums, int i, int window) {
  Floats sum = Floats::load(sums + i);
  for (int k = 1; k < window; ++k) sum += Floats::load(sums + i + k);
  return sum * float(1.0 / (window * window));
}

// The costs of one plane against one other photo, sorted in among the lowest of the `before` photos before it.
void compare(const Sweep& s, const Swept& o, float inverse_depth, int first, int last, int before, int most, Band& t) {
  for (int k = 0; k < last - first + 2 * t.radius; ++k)
    draw(s, o, inverse_depth, std::clamp(first - t.radius + k, 0, s.height - 1), &t.drawn[k * t.row], &t.reaches[k * t.row]);
  for (int y = first; y < last; ++y) {
    add_columns(s, y, &t.drawn[(y - first) * t.row], t);
    const float *b = t.sums.data(), *bb = b + t.border, *ab = bb + t.border, *reach = &t.reaches[(y - first + t.radius) * t.row];
    for (int i = 0; i < s.width; i += kLanes) {
      const int count = std::min(kLanes, s.width - i);
      const std::ptrdiff_t at = std::ptrdiff_t(y) * s.width + i;
      const Floats mean = window_mean(b, i, s.window), variance = window_mean(bb, i, s.window) - mean * mean;
      const Floats covariance = window_mean(ab, i, s.window) - load_some(s.mean + at, count) * mean;
      const Floats deviation = root(maximum(variance, Floats(0.0f)) + s.floor) * load_some(s.deviation + at, count);
      Floats cost = (1.0f - where(Floats::load(reach + i) < 1.0f, covariance) / deviation) * 0.5f;
      float* lowest = &t.lowest[(y - first) * t.row + i];
      for (int k = 0; k < std::min(before, most); ++k, lowest += t.size) {
        const Floats kept = Floats::load(lowest);
        minimum(kept, cost).store(lowest), cost = maximum(kept, cost);
      }
      if (before < most) cost.store(lowest);
    }
  }
}

}  // namespace

void cost_volume(const Sweep& s, const float* inverse_depths, int planes, float* volume, int threads) {
  const int others = int(s.others.size()), most = (others + 1) / 2;
  Pool::instance().run(threads, (s.height + kBand - 1) / kBand, [&](std::int64_t task) {
    const int first = int(task) * kBand, last = std::min(first + kBand, s.height);
    Band t(s, most);
    for (int p = 0; p < planes; p += kPlanes) {
      const int count = std::min(kPlanes, planes - p);
      for (int q = 0; q < count; ++q) {
        for (int k = 0; k < others; ++k) compare(s, s.others[k], inverse_depths[p + q], first, last, k, most, t);
        for (int i = 0; i < t.size; i += kLanes) {
          Floats sum = Floats::load(&t.lowest[i]);
          for (int k = 1; k < most; ++k) sum += Floats::load(&t.lowest[k * t.size + i]);
          (sum / Floats(float(most))).store(&t.means[q * t.size + i]);
        }
      }
      for (int y = first; y < last; ++y) {
        float* to = volume + std::ptrdiff_t(y) * s.width * planes + p;
        const float* from = &t.means[(y - first) * t.row];
        for (int i = 0; i < s.width; ++i, to += planes)
          for (int q = 0; q < count; ++q) to[q] = from[q * t.size + i];
      }
    }
  });
}

}  // namespace clear
