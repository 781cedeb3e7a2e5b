// L1 and mean SSIM (11 x 11 Gaussian window, σ = 1.5, zero padding) with their gradient, in one pass over the images.
//
// With the difference e = y - x of the images, SSIM factorises:
//
//   SSIM = (1 - u)(1 - n),   u = μe² / B1,  1 - u = A1 / B1,  A1 = 2 μx μy + C1,  B1 = A1 + μe²,
//                            n = σe² / B2,  1 - n = A2 / B2,  A2 = 2 σxy + C2,    B2 = A2 + σe².
//
// With a window w around q, the gradient at a pixel p is
//
//   ∂Σ SSIM / ∂x_p = Σ_q w(p-q) [a(q) + b(q) (y_p - μy(q)) + c(q) (e_p - μe(q))],
//   a = 2 (1-n) ((1-u) μe + u μy) / B1,   b = 2 (1-u) n / B2,   c = 2 (1-u) (1-n) / B2.
//
// Every factor is accurate wherever it counts. Where the images are nearly equal, u and n are small numbers, not differences
// of nearly equal ones; equal images give exactly 1 and gradient 0. Where y is dark or flat beside x, u or n is nearly 1, and
// 1 - u and 1 - n are not subtracted. y is summed itself, because y found from x + y and e would be off by the rounding of x.
//
// Windows are separable: columns first, then rows. E[s²] - E[s]² would lose the variance of flat regions, so every sum is
// taken about a value inside its window: a pixel of the column for the column sums, the column's mean for the row sums
// (the variance of the columns' means is added to the columns' variances). The gradient's sums are taken about local
// means in the same way.
//
// Channels are interleaved, so a neighbour is three numbers away and a row is W · 3 numbers. The image is split into tiles
// that depend only on its size. A tile processes four rows at a time, and keeps the last sixteen rows of its inputs in ring
// buffers that fit the L2 cache.
#pragma once

#include <algorithm>
#include <cstring>
#include <vector>

#include "images.hpp"
#include "pool.hpp"
#include "simd.hpp"

namespace clear {

// The loss: l1 · mean |x - y| + dssim · (1 - SSIM).
struct PhotometricWeights {
  float l1, dssim;
};

struct PhotometricMeans {
  double l1, dssim;  // mean |x - y|, 1 - SSIM
};

namespace ssim {

using Floats = Lanes<float>;

inline constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
inline constexpr int kReach = 5, kTaps = 2 * kReach + 1;
inline constexpr float kWindow[kTaps] = {0.001028380084f, 0.007598758135f, 0.03600077213f, 0.1093606895f,
                                         0.2130055377f,   0.2660117249f,   0.2130055377f,  0.1093606895f,
                                         0.03600077213f,  0.007598758135f, 0.001028380084f};

inline constexpr int kGroup = 4;                   // rows that are computed together
inline constexpr int kSpan = kGroup + kTaps - 1;   // the rows that they depend on
inline constexpr int kRing = 16;                   // rows in a ring buffer
inline constexpr int kHalo = 16;                   // numbers beside a tile that its windows reach, rounded up to whole Lanes
static_assert(kRing >= kSpan && kHalo >= kReach * kChannels && kHalo % kLanes == 0);

// The largest tile, in numbers and rows; the tiles of an image have about equal sizes. Narrow tiles keep the rows of a group
// in the L1 cache: wider ones compute fewer numbers twice, but take longer.
inline constexpr int kTileWidth = 256;
inline constexpr int kTileHeight = 128;

// One register rather than sixteen numbers: with few registers, what these loops keep fits only in this way.
using Register = Native<float>::Register;
inline constexpr int kWidth = Native<float>::width;

CLEAR_INLINE Register load(const float* p) {
  Register a;
  std::memcpy(&a, p, sizeof a);
  return a;
}
CLEAR_INLINE void store(float* p, const Register& a) { std::memcpy(p, &a, sizeof a); }

// How many of a group's rows fit the registers.
inline constexpr int kTogether = kRegisterBytes == 64 ? 4 : 2;

// The last kRing rows of something.
struct Ring {
  float* data;
  int width;
  float* row(int r) const { return data + std::ptrdiff_t(r & (kRing - 1)) * width; }
};

struct Tile {
  int top, bottom, left, right;  // rows and numbers of a row, ends excluded

  // Numbers from the left end to the last whole Lanes.
  int width() const { return (right - left + kLanes - 1) / kLanes * kLanes; }
};

inline double total(const Floats& v) {
  float lanes[kLanes];
  v.store(lanes);
  double all = 0;
  for (float lane : lanes) all += lane;
  return all;
}

// The input of a group's column sums: the kSpan rows from 5 above the group's first row to 5 below its last.
struct Columns {
  const float *y[kSpan], *e[kSpan];
  const float *y_origin, *e_origin;
};

// Column means of y and e, covariances of x and y, and variances of e, for rows [first, first + Rows) of the group.
template <int Rows>
void down_columns(const Columns& in, int first, int width, float* const* mean_y, float* const* mean_e,
                  float* const* cov_xy, float* const* var_e) {
  for (int i = 0; i < width; i += kWidth) {
    Register y0 = load(in.y_origin + i), e0 = load(in.e_origin + i);
    Register my[Rows], me[Rows], vxy[Rows], ve[Rows];
#pragma GCC unroll 4
    for (int r = 0; r < Rows; ++r) my[r] = me[r] = vxy[r] = ve[r] = Register{};
#pragma GCC unroll 16
    for (int k = 0; k < Rows + kTaps - 1; ++k) {
      Register y = load(in.y[first + k] + i) - y0, e = load(in.e[first + k] + i) - e0;
      Register xy = (y - e) * y, ee = e * e;
#pragma GCC unroll 4
      for (int r = 0; r < Rows; ++r) {
        if (k < r || k - r >= kTaps) continue;
        const float w = kWindow[k - r];
        my[r] += w * y;
        me[r] += w * e;
        vxy[r] += w * xy;
        ve[r] += w * ee;
      }
    }
#pragma GCC unroll 4
    for (int r = 0; r < Rows; ++r) {
      store(mean_y[first + r] + i, y0 + my[r]);
      store(mean_e[first + r] + i, e0 + me[r]);
      store(cov_xy[first + r] + i, vxy[r] - (my[r] - me[r]) * my[r]);
      store(var_e[first + r] + i, ve[r] - me[r] * me[r]);
    }
  }
}

// The maps of one row: local means, the gradient's coefficients, and 1 - SSIM.
struct MapRow {
  float *mean_y, *mean_e, *a, *b, *c, *dissimilarity;
};

// Computes the windows' means and (co)variances from those of the columns, and the maps from them. `mean_y`, … start kHalo
// numbers before the maps.
inline void along_row(const float* mean_y, const float* mean_e, const float* cov_xy, const float* var_e, int width,
                      const MapRow& out) {
  for (int i = 0; i < width; i += kWidth) {
    int at = i + kHalo;
    Register y0 = load(mean_y + at), e0 = load(mean_e + at), w0 = kWindow[kReach] - Register{};
    Register my{}, me{}, vxy = w0 * load(cov_xy + at), ve = w0 * load(var_e + at);
#pragma GCC unroll 16
    for (int k = 0; k < kTaps; ++k) {
      if (k == kReach) continue;
      int from = at + (k - kReach) * kChannels;
      const float w = kWindow[k];
      Register y = load(mean_y + from) - y0, e = load(mean_e + from) - e0;
      my += w * y;
      me += w * e;
      vxy += w * (load(cov_xy + from) + (y - e) * y);
      ve += w * (load(var_e + from) + e * e);
    }
    vxy -= (my - me) * my;
    ve -= me * me;
    my += y0;
    me += e0;
    const float two = 2.0f;
    const Register me2 = me * me;
    const Register A1 = two * (my - me) * my + kC1, A2 = two * vxy + kC2;
    const Register over_B1 = Native<float>::reciprocal(A1 + me2), over_B2 = Native<float>::reciprocal(A2 + ve);
    const Register u = me2 * over_B1, n = ve * over_B2, not_u = A1 * over_B1, not_n = A2 * over_B2;
    const Register scale = two * not_u * over_B2;
    store(out.mean_y + i, my);
    store(out.mean_e + i, me);
    store(out.a + i, two * not_n * (not_u * me + u * my) * over_B1);
    store(out.b + i, scale * n);
    store(out.c + i, scale * not_n);
    store(out.dissimilarity + i, u + n - u * n);
  }
}

// The kSpan rows of maps around a group, and the row of local means that the sums are taken about.
struct Maps {
  const float *mean_y[kSpan], *mean_e[kSpan], *a[kSpan], *b[kSpan], *c[kSpan];
  const float *y_origin, *e_origin;
};

// The gradient's column sums: Σ w [a + b (y0 - μy) + c (e0 - μe)], Σ w b and Σ w c.
template <int Rows>
void down_maps(const Maps& in, int first, int width, float* const* sum_a, float* const* sum_b, float* const* sum_c) {
  for (int i = 0; i < width; i += kWidth) {
    Register y0 = load(in.y_origin + i), e0 = load(in.e_origin + i);
    Register A[Rows], B[Rows], C[Rows];
#pragma GCC unroll 4
    for (int r = 0; r < Rows; ++r) A[r] = B[r] = C[r] = Register{};
#pragma GCC unroll 16
    for (int k = 0; k < Rows + kTaps - 1; ++k) {
      Register b = load(in.b[first + k] + i), c = load(in.c[first + k] + i);
      Register a = load(in.a[first + k] + i) + b * (y0 - load(in.mean_y[first + k] + i)) +
                 c * (e0 - load(in.mean_e[first + k] + i));
#pragma GCC unroll 4
      for (int r = 0; r < Rows; ++r) {
        if (k < r || k - r >= kTaps) continue;
        const float w = kWindow[k - r];
        A[r] += w * a;
        B[r] += w * b;
        C[r] += w * c;
      }
    }
#pragma GCC unroll 4
    for (int r = 0; r < Rows; ++r) {
      store(sum_a[first + r] + i, A[r]);
      store(sum_b[first + r] + i, B[r]);
      store(sum_c[first + r] + i, C[r]);
    }
  }
}

// Sum of n numbers, accumulated in float by lane.
inline double total(const float* values, int n) {
  Floats sum(0.0f);
  int i = 0;
  for (; i + kLanes <= n; i += kLanes) sum += Floats::load(values + i);
  double all = total(sum);
  for (; i < n; ++i) all += values[i];
  return all;
}

struct GradientRow {
  float* to;
  int length;
  float l1_scale, ssim_scale;
};

// Computes the gradient of one row from the column sums about y_origin and e_origin, all of which start kHalo numbers
// before the row; returns Σ |e|.
inline double along_sums(const float* sum_a, const float* sum_b, const float* sum_c, const float* y_origin,
                         const float* e_origin, const float* y, const float* e, const GradientRow& out) {
  Floats zero(0.0f), step(out.l1_scale), absolute_sum(0.0f);
  for (int i = 0; i < out.length; i += kLanes) {
    Floats y0 = Floats::load(y + i), e0 = Floats::load(e + i), g(0.0f);
#pragma GCC unroll 16
    for (int k = 0; k < kTaps; ++k) {
      int from = i + kHalo + (k - kReach) * kChannels;
      g += Floats(kWindow[k]) *
           (Floats::load(sum_a + from) + Floats::load(sum_b + from) * (y0 - Floats::load(y_origin + from)) +
            Floats::load(sum_c + from) * (e0 - Floats::load(e_origin + from)));
    }
    g = where(e0 < zero, step) - where(e0 > zero, step) + Floats(out.ssim_scale) * g;
    absolute_sum += absolute(e0);
    if (i + kLanes <= out.length) {
      g.store(out.to + i);
    } else {
      float lanes[kLanes];
      g.store(lanes);
      std::memcpy(out.to + i, lanes, sizeof(float) * std::size_t(out.length - i));
    }
  }
  return total(absolute_sum);
}

// A thread's buffers, kept between calls because fresh memory costs a page fault every 4 KB.
inline float* scratch(std::size_t n) {
  static thread_local std::vector<float> memory;
  if (memory.size() < n) memory.resize(n);
  return memory.data();
}

// Writes a tile's part of the gradient; returns its part of the sums.
inline PhotometricMeans run_tile(const ImagePair& im, const Tile& t, PhotometricWeights weights) {
  const int width = t.width(), map_width = width + 2 * kHalo, in_width = map_width + 2 * kHalo;
  const int in_left = t.left - 2 * kHalo, map_left = t.left - kHalo;
  const float share = 1.0f / (float(im.height) * float(im.row));
  const float l1_scale = weights.l1 * share, ssim_scale = -weights.dssim * share;

  float* free = scratch(std::size_t(in_width) * (2 * kRing + 4 * kGroup) +
                        std::size_t(map_width) * (5 * kRing + 1 + 3 * kGroup));
  auto take = [&free](std::ptrdiff_t n) {
    float* p = free;
    free += n;
    return p;
  };
  auto ring = [&take](int w) { return Ring{take(std::ptrdiff_t(w) * kRing), w}; };
  Ring y = ring(in_width), e = ring(in_width);
  Ring mean_y = ring(map_width), mean_e = ring(map_width), a = ring(map_width), b = ring(map_width), c = ring(map_width);
  float *column[4][kGroup], *sum[3][kGroup], *dissimilarity = take(map_width);
  for (auto& quantity : column)
    for (float*& row : quantity) row = take(in_width);
  for (auto& quantity : sum)
    for (float*& row : quantity) row = take(map_width);

  // Rows of y and e, zero outside the image.
  auto read = [&](int r) {
    float *to_y = y.row(r), *to_e = e.row(r);
    std::fill_n(to_y, in_width, 0.0f);
    std::fill_n(to_e, in_width, 0.0f);
    if (r < 0 || r >= im.height) return;
    int begin = std::max(0, in_left), end = std::min(im.row, in_left + in_width);
    const float *from_x = im.x + std::ptrdiff_t(r) * im.row, *from_y = im.y + std::ptrdiff_t(r) * im.row;
    for (int i = begin; i < end; ++i) {
      to_y[i - in_left] = from_y[i];
      to_e[i - in_left] = from_y[i] - from_x[i];
    }
  };

  PhotometricMeans sums{0, 0};
  // The maps of rows [q, q + 4); zero outside the image.
  auto forward = [&](int q) {
    Columns in;
    for (int k = 0; k < kSpan; ++k) in.y[k] = y.row(q - kReach + k), in.e[k] = e.row(q - kReach + k);
    int origin = std::clamp(q + kGroup / 2, 0, im.height - 1);
    in.y_origin = y.row(origin), in.e_origin = e.row(origin);
    for (int r = 0; r < kGroup; r += kTogether)
      down_columns<kTogether>(in, r, in_width, column[0], column[1], column[2], column[3]);
    for (int r = 0; r < kGroup; ++r) {
      int at = q + r;
      MapRow out{mean_y.row(at), mean_e.row(at), a.row(at), b.row(at), c.row(at), dissimilarity};
      int begin = std::max(0, -map_left), end = std::min(map_width, im.row - map_left);
      if (at < 0 || at >= im.height) begin = end = 0;
      else along_row(column[0][r], column[1][r], column[2][r], column[3][r], map_width, out);
      for (float* row : {out.mean_y, out.mean_e, out.a, out.b, out.c}) {
        std::fill(row, row + begin, 0.0f);
        std::fill(row + end, row + map_width, 0.0f);
      }
      if (at >= t.top && at < t.bottom) sums.dssim += total(dissimilarity + kHalo, t.right - t.left);
    }
  };
  // The gradient of rows [p, p + 4).
  auto backward = [&](int p) {
    Maps in;
    for (int k = 0; k < kSpan; ++k) {
      int r = p - kReach + k;
      in.mean_y[k] = mean_y.row(r), in.mean_e[k] = mean_e.row(r);
      in.a[k] = a.row(r), in.b[k] = b.row(r), in.c[k] = c.row(r);
    }
    int origin = std::min(p + kGroup / 2, im.height - 1);
    in.y_origin = mean_y.row(origin), in.e_origin = mean_e.row(origin);
    for (int r = 0; r < kGroup; r += kTogether) down_maps<kTogether>(in, r, map_width, sum[0], sum[1], sum[2]);
    for (int r = 0; r < kGroup && p + r < t.bottom; ++r) {
      GradientRow out{im.gradient + std::ptrdiff_t(p + r) * im.row + t.left, t.right - t.left, l1_scale, ssim_scale};
      sums.l1 += along_sums(sum[0][r], sum[1][r], sum[2][r], in.y_origin, in.e_origin, y.row(p + r) + 2 * kHalo,
                            e.row(p + r) + 2 * kHalo, out);
    }
  };

  // After the maps of a group, the gradient of the group five rows above has all of its inputs.
  int q = t.top - kReach - 2;  // whole groups: -7 = -12 + 5
  for (int r = q - kReach; r < q + kReach; ++r) read(r);
  for (; q - kReach < t.bottom; q += kGroup) {
    for (int r = 0; r < kGroup; ++r) read(q + kReach + r);
    forward(q);
    if (q - kReach >= t.top) backward(q - kReach);
  }
  return sums;
}

}  // namespace ssim

// L1 alone; no windows.
inline double l1_with_gradient(const ImagePair& im, float weight, int threads) {
  using ssim::Floats;
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
    double all = ssim::total(sum);
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

// Writes the gradient of l1 · mean |x - y| + dssim · (1 - SSIM) with respect to x; returns both means. With dssim = 0 no
// SSIM is computed, and its mean is 0.
inline PhotometricMeans photometric(const ImagePair& im, PhotometricWeights weights, int threads) {
  if (weights.dssim == 0) return {l1_with_gradient(im, weights.l1, threads), 0};
  auto parts = [](int size, int aim, int whole) {  // equal parts of about `aim`, in multiples of `whole`
    int count = (size + aim - 1) / aim, part = (size + count - 1) / count;
    return (part + whole - 1) / whole * whole;
  };
  int width = parts(im.row, ssim::kTileWidth, kLanes), height = parts(im.height, ssim::kTileHeight, ssim::kGroup);
  int across = (im.row + width - 1) / width, down = (im.height + height - 1) / height;
  std::vector<PhotometricMeans> sums(std::size_t(across) * down);
  Pool::instance().run(threads, std::int64_t(sums.size()), [&](std::int64_t i) {
    int top = int(i) / across * height, left = int(i) % across * width;
    ssim::Tile tile{top, std::min(top + height, im.height), left, std::min(left + width, im.row)};
    sums[i] = ssim::run_tile(im, tile, weights);
  });
  PhotometricMeans means{0, 0};
  for (const PhotometricMeans& part : sums) means.l1 += part.l1, means.dssim += part.dssim;
  double n = double(im.height) * im.row;
  return {means.l1 / n, means.dssim / n};
}

}  // namespace clear
