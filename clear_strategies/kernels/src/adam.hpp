// Adam on sixteen numbers, and on rows of any length. Same operations as training.optim.Adam, except that the division by
// the second moment's bias is a multiplication here.
#pragma once

#include <cstddef>
#include <limits>

#include "block.hpp"

namespace clear {

struct AdamStep {
  float beta1, beta2, gain1, gain2;  // gain = 1 - beta
  float per_bias2, eps;  // 1 / bias of the second moment
};

// One parameter tensor with its moments [N, width], what is added to its gradient, and its limits.
struct Attribute {
  float *p, *m, *v;
  int width;
  const float* hr = nullptr;    // ĝ_HR where a strategy has corrected it by itself, in place of the one of the losses; or null
  const float* plus = nullptr;  // added to the merged gradient, or null
  float rate;                   // - learning rate / bias of the first moment
  float keep = 1;               // factor of the decay per step (f_det), 1: none
  float limit = std::numeric_limits<float>::infinity();
};

CLEAR_INLINE Floats clamp_keeping_nan(const Floats& x, const Floats& limit) {
  return minimum(limit, maximum(-limit, x));  // returns the second operand if it is NaN
}

struct Adam {
  Floats p, m, v;

  // Decay and step.
  CLEAR_INLINE void step(const AdamStep& s, const Attribute& a, const Floats& g) {
    m = multiply_add(g, s.gain1, m * Floats(s.beta1));
    v = multiply_add(g * Floats(s.gain2), g, v * Floats(s.beta2));
    Floats denominator = root(v * Floats(s.per_bias2)) + Floats(s.eps);
    p = p * Floats(a.keep) + m * Floats(a.rate) / denominator;
  }
};

// The merged gradient with what the losses do not give: + λ_HR ĝ_HR + plus, for `count` numbers from `offset` on.
CLEAR_INLINE Floats with_given(const Attribute& a, Floats g, float lambda_hr, std::int64_t offset, int count) {
  if (a.hr) g += load_some(a.hr + offset, count) * Floats(lambda_hr);
  if (a.plus) g += load_some(a.plus + offset, count);
  return g;
}

// Steps sixteen numbers, and clamps them to the limit.
CLEAR_INLINE void step_sixteen(const AdamStep& s, const Attribute& a, float* p, float* m, float* v, const Floats& g) {
  Adam x{Floats::load(p), Floats::load(m), Floats::load(v)};
  x.step(s, a, g);
  clamp_keeping_nan(x.p, a.limit).store(p);
  x.m.store(m), x.v.store(v);
}

// Steps `count` numbers from `offset` on. `g` is padded to whole vectors.
inline void step_numbers(const AdamStep& s, const Attribute& a, float lambda_hr, std::int64_t offset, int count, const float* g) {
  float *p = a.p + offset, *m = a.m + offset, *v = a.v + offset;
  int j = 0;
  for (; j + kLanes <= count; j += kLanes)
    step_sixteen(s, a, p + j, m + j, v + j, with_given(a, Floats::load(g + j), lambda_hr, offset + j, kLanes));
  if (j == count) return;
  float last[4][kLanes] = {};  // the rest of the last rows
  std::size_t bytes = sizeof(float) * (count - j);
  std::memcpy(last[0], p + j, bytes), std::memcpy(last[1], m + j, bytes), std::memcpy(last[2], v + j, bytes);
  std::memcpy(last[3], g + j, bytes);
  step_sixteen(s, a, last[0], last[1], last[2], with_given(a, Floats::load(last[3]), lambda_hr, offset + j, count - j));
  std::memcpy(p + j, last[0], bytes), std::memcpy(m + j, last[1], bytes), std::memcpy(v + j, last[2], bytes);
}

// A row that takes no step: decay and clamp only.
inline void rest_row(const Attribute& a, std::int64_t row) {
  if (a.keep == 1 && a.limit == std::numeric_limits<float>::infinity()) return;
  for (int d = 0; d < a.width; ++d) {
    float& p = a.p[row * a.width + d];
    p *= a.keep;
    p = p > a.limit ? a.limit : p < -a.limit ? -a.limit : p;
  }
}

// Whether no value has a bit set but its sign. By whole registers: the rows are rarely in the cache, and a processor that
// runs ahead of a short loop has the next rows on their way.
CLEAR_INLINE bool all_zero(const float* values, int count) {
  typedef std::uint32_t Bits __attribute__((vector_size(sizeof(float) * kLanes)));
  Bits found = {};
  int k = 0;
  auto add = [&](const float* from, int numbers) CLEAR_LAMBDA {
    Bits bits = {};
    std::memcpy(&bits, from, sizeof(float) * numbers);
    found |= bits;
  };
  for (; k + kLanes <= count; k += kLanes) add(values + k, kLanes);
  if (k < count && count >= kLanes) add(values + count - kLanes, kLanes);  // the last sixteen
  std::uint32_t any = 0;
  if (count < kLanes)
    for (; k < count; ++k) {
      std::uint32_t bits;
      std::memcpy(&bits, values + k, sizeof bits);
      any |= bits;
    }
  else
    for (int i = 0; i < kLanes; ++i) any |= found[i];
  return any << 1 == 0;
}

// Whether a row to which the losses give nothing would stay as it is: both moments and what is added are 0.
inline bool is_still(const Attribute& a, std::int64_t row, int width) {
  std::int64_t at = row * a.width;
  if (!all_zero(a.m + at, width) || !all_zero(a.v + at, width)) return false;
  return (!a.hr || all_zero(a.hr + at, width)) && (!a.plus || all_zero(a.plus + at, width));
}

}  // namespace clear
