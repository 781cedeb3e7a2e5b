#include "wander.hpp"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <vector>

#include "block.hpp"
#include "pool.hpp"

namespace clear {
namespace {

// A float's bits as an integer with the order of the floats, NaN at its ends: a comparison of NaNs would have no order.
std::int32_t ordered(std::int32_t bits) { return bits ^ ((bits >> 31) & 0x7fffffff); }

// The lower median of the largest of each Gaussian's three numbers.
float median_of_largest(const float* scales, std::int64_t n) {
  std::vector<std::int32_t> largest(n);
  for (std::int64_t i = 0; i < n; ++i) {
    const float* s = scales + 3 * i;
    largest[i] = ordered(std::bit_cast<std::int32_t>(std::max(s[0], std::max(s[1], s[2]))));
  }
  auto middle = largest.begin() + (n - 1) / 2;
  std::nth_element(largest.begin(), middle, largest.end());
  return std::bit_cast<float>(ordered(*middle));
}

// Rotates v, or rotates it back, by the unit quaternion q (wxyz).
CLEAR_INLINE void rotate(const Floats (&q)[4], const Floats (&v)[3], bool back, Floats (&out)[3]) {
  const Floats one = 1.0f, two = 2.0f, &x = q[1], &y = q[2], &z = q[3], w = back ? -q[0] : q[0];
  out[0] = (one - two * (y * y + z * z)) * v[0] + two * (x * y - w * z) * v[1] + two * (x * z + w * y) * v[2];
  out[1] = two * (x * y + w * z) * v[0] + (one - two * (x * x + z * z)) * v[1] + two * (y * z - w * x) * v[2];
  out[2] = two * (x * z - w * y) * v[0] + two * (y * z + w * x) * v[1] + (one - two * (x * x + y * y)) * v[2];
}

// As rasterizers.geometry.rotation_matrix: of any length, and the zero quaternion is the identity.
CLEAR_INLINE void normalize(Floats (&q)[4]) {
  Floats largest = maximum(maximum(absolute(q[0]), absolute(q[1])), maximum(absolute(q[2]), absolute(q[3])));
  auto any = largest > Floats(0.0f);
  largest = maximum(largest, Floats(std::numeric_limits<float>::min()));
  for (int k = 0; k < 4; ++k) q[k] = select(any, q[k] / largest, Floats(k == 0 ? 1.0f : 0.0f));
  Floats norm = root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (Floats& x : q) x = x / norm;
}

// columns[d] lane k = table[rows[k] · D + d]; lanes beyond `count` are 0.
template <int D>
CLEAR_INLINE void gather(const float* table, const std::int64_t* rows, int count, Floats (&columns)[D]) {
  float a[D][kLanes] = {};
  for (int k = 0; k < count; ++k)
    for (int d = 0; d < D; ++d) a[d][k] = table[rows[k] * D + d];
  for (int d = 0; d < D; ++d) columns[d] = Floats::load(a[d]);
}

void sixteen(const Field& field, const std::int64_t* rows, const float* eta, int count, float strength) {
  Floats q[4], s[3], gate[1], noise[3], local[3], moved[3];
  gather(field.quats, rows, count, q), gather(field.scales, rows, count, s), gather(field.gate, rows, count, gate);
  load_columns(eta, count, noise);
  normalize(q);
  rotate(q, noise, true, local);
  for (int d = 0; d < 3; ++d) {
    const Floats size = exponential(s[d]);
    local[d] *= size * size;  // S² Rᵀ η
  }
  rotate(q, local, false, moved);
  for (int d = 0; d < 3; ++d) {
    float by[kLanes];
    (moved[d] * gate[0] * Floats(strength)).store(by);
    for (int k = 0; k < count; ++k) field.means[3 * rows[k] + d] += by[k];
  }
}

}  // namespace

void wander(const Field& field, const std::int64_t* rows, const float* eta, std::int64_t count, float strength, int threads) {
  if (count == 0) return;
  const float share = strength / std::exp(median_of_largest(field.scales, field.n));
  Pool::instance().run(threads, chunks(count), [&](std::int64_t number) {
    each_sixteen(count, number, [&](std::int64_t k, int lanes) { sixteen(field, rows + k, eta + 3 * k, lanes, share); });
  });
}

}  // namespace clear
