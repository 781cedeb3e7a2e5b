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
// taken about a value inside its window, which a few neighbouring windows share. The rows' windows add the variance of the
// columns' means to the columns' variances. The gradient's sums are taken about a pixel near their middle.
#pragma once

#include <cstring>

#include "simd.hpp"

namespace clear::ssim {

inline constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
inline constexpr int kReach = 5, kTaps = 2 * kReach + 1;
inline constexpr float kWindow[kReach + 1] = {0.001028380084f, 0.007598758135f, 0.03600077213f,
                                              0.1093606895f,   0.2130055377f,   0.2660117249f};  // and back to the first

// One register rather than sixteen numbers: with few registers, what these loops keep fits only in this way.
using Register = Native<float>::Register;
inline constexpr int kWidth = Native<float>::width;

CLEAR_INLINE Register load(const float* p) {
  Register a;
  std::memcpy(&a, p, sizeof a);
  return a;
}
CLEAR_INLINE void store(float* p, const Register& a) { std::memcpy(p, &a, sizeof a); }

inline double total(const Register& a) {
  double sum = 0;
  for (int i = 0; i < kWidth; ++i) sum += a[i];
  return sum;
}

// How many numbers N neighbouring windows cover.
constexpr int span(int windows) { return windows + kTaps - 1; }

// Σ w v of N neighbouring windows. The two numbers of equal weight are added first.
template <int N, class Value>
CLEAR_INLINE void windows(Value&& value, Register (&sums)[N]) {
  Register v[span(N)];
#pragma GCC unroll 16
  for (int k = 0; k < span(N); ++k) v[k] = value(k);
#pragma GCC unroll 16
  for (int i = 0; i < N; ++i) sums[i] = kWindow[kReach] * v[i + kReach];
#pragma GCC unroll 16
  for (int k = 0; k < kReach; ++k)  // the windows in turn, because a sum waits for its previous term
    for (int i = 0; i < N; ++i) sums[i] += kWindow[k] * (v[i + k] + v[i + kTaps - 1 - k]);
}

// In a window: the means of y and e, the covariance of x and y, and the variance of e.
struct Moments {
  Register y, e, xy, ee;
};

// The moments of N neighbouring windows. y(k) and e(k) are the numbers that they cover; add_xy(k, …) and add_ee(k, …) add what
// the k-th already is the covariance and the variance of.
template <int N, class Y, class E, class XY, class EE>
CLEAR_INLINE void moments(Y&& y, E&& e, XY&& add_xy, EE&& add_ee, Moments (&out)[N]) {
  constexpr int middle = span(N) / 2;
  const Register y0 = y(middle), e0 = e(middle);
  Register sum_y[N], sum_e[N], sum_xy[N], sum_ee[N];
  const auto dy = [&](int k) CLEAR_LAMBDA { return y0 - y(k); };
  const auto de = [&](int k) CLEAR_LAMBDA { return e0 - e(k); };
  windows<N>(dy, sum_y);
  windows<N>([&](int k) CLEAR_LAMBDA { return add_xy(k, dy(k) * (dy(k) - de(k))); }, sum_xy);
  windows<N>(de, sum_e);
  windows<N>([&](int k) CLEAR_LAMBDA { return add_ee(k, de(k) * de(k)); }, sum_ee);
#pragma GCC unroll 16
  for (int r = 0; r < N; ++r)
    out[r] = {y0 - sum_y[r], e0 - sum_e[r], sum_xy[r] - (sum_y[r] - sum_e[r]) * sum_y[r], sum_ee[r] - sum_e[r] * sum_e[r]};
}

// The gradient's coefficients at a pixel, and 1 - SSIM.
struct Coefficients {
  Register a, b, c, dissimilarity;
};

// `inside` is 1 in the image, and 0 outside, where nothing is compared.
CLEAR_INLINE Coefficients coefficients(const Moments& m, const Register& inside) {
  const float two = 2.0f;
  const Register me2 = m.e * m.e;
  const Register A1 = two * (m.y - m.e) * m.y + kC1, A2 = two * m.xy + kC2;
  const Register over_B1 = inside * Native<float>::reciprocal(A1 + me2);
  const Register over_B2 = inside * Native<float>::reciprocal(A2 + m.ee);
  const Register u = me2 * over_B1, n = m.ee * over_B2, not_u = A1 * over_B1, not_n = A2 * over_B2;
  const Register scale = two * not_u * over_B2;
  return {two * not_n * (not_u * m.e + u * m.y) * over_B1, scale * n, scale * not_n, u + n - u * n};
}

// In a window: Σ w [a + b (y0 - μy) + c (e0 - μe)] for a pixel's y0 and e0, Σ w b and Σ w c.
struct Sums {
  Register a, b, c;
};

// The sums of N neighbouring windows about one pixel.
template <int N, class Y, class E, class A, class B, class C>
CLEAR_INLINE void sums(const Register& y0, const Register& e0, Y&& mean_y, E&& mean_e, A&& a, B&& b, C&& c, Sums (&out)[N]) {
  Register sum_a[N], sum_b[N], sum_c[N];
  windows<N>([&](int k) CLEAR_LAMBDA { return a(k) + b(k) * (y0 - mean_y(k)) + c(k) * (e0 - mean_e(k)); }, sum_a);
  windows<N>(b, sum_b);
  windows<N>(c, sum_c);
#pragma GCC unroll 16
  for (int r = 0; r < N; ++r) out[r] = {sum_a[r], sum_b[r], sum_c[r]};
}

}  // namespace clear::ssim
