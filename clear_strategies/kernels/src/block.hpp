// How passes over the Gaussians are cut, rows in memory as lanes, and arithmetic that only the trainer's kernels need.
#pragma once

#include <algorithm>
#include <cstdint>

#include "rows.hpp"

namespace clear {

using Floats = Lanes<float>;
using Doubles = Lanes<double>;

inline constexpr std::int64_t kChunk = 1024;  // Gaussians per task, a multiple of sixteen

inline std::int64_t chunks(std::int64_t n) { return (n + kChunk - 1) / kChunk; }

CLEAR_INLINE std::uint32_t first_bits(int count) { return count == kLanes ? 0xffffu : (1u << count) - 1; }

// Calls task(i, count) for every sixteen Gaussians of chunk `number`.
template <class Task>
CLEAR_INLINE void each_sixteen(std::int64_t n, std::int64_t number, Task&& task) {
  std::int64_t end = std::min(n, (number + 1) * kChunk);
  for (std::int64_t i = number * kChunk; i < end; i += kLanes) task(i, int(std::min<std::int64_t>(kLanes, end - i)));
}

// columns[d] lane i = rows[i · stride + d] for the first `count` rows; lanes beyond are 0.
template <int D>
CLEAR_INLINE void load_columns(const float* rows, int count, Floats (&columns)[D], int stride = D) {
  if (count == kLanes && stride == D) {
    split_rows(rows, columns);
    return;
  }
  float a[D][kLanes] = {};
  for (int i = 0; i < count; ++i)
    for (int d = 0; d < D; ++d) a[d][i] = rows[std::int64_t(i) * stride + d];
  for (int d = 0; d < D; ++d) columns[d] = Floats::load(a[d]);
}

template <class T>
CLEAR_INLINE Lanes<T> load_some(const T* values, int count) {
  if (count == kLanes) return Lanes<T>::load(values);
  T a[kLanes] = {};
  for (int i = 0; i < count; ++i) a[i] = values[i];
  return Lanes<T>::load(a);
}

template <class T>
CLEAR_INLINE void store_some(T* to, const Lanes<T>& values, int count) {
  if (count == kLanes) return values.store(to);
  T a[kLanes];
  values.store(a);
  for (int i = 0; i < count; ++i) to[i] = a[i];
}

// Prefetches the rows [row, end). There are more tensors here than the hardware prefetches.
CLEAR_INLINE void fetch_rows(const float* tensor, std::int64_t row, std::int64_t end, int width) {
  if (!tensor) return;
  for (const float *p = tensor + row * width, *last = tensor + end * width; p < last; p += kLanes) __builtin_prefetch(p, 0, 2);
}

// The same of sixteen rows.
CLEAR_INLINE void fetch_rows(const float* tensor, std::int64_t row, int width) {
  fetch_rows(tensor, row, row + kLanes, width);
}

CLEAR_INLINE Doubles widen(const Floats& a) { return convert<double>(a); }
CLEAR_INLINE Floats narrow(const Doubles& a) { return convert<float>(a); }

CLEAR_INLINE double sum(const Doubles& a) {
  double values[kLanes], total = 0;
  a.store(values);
  for (double value : values) total += value;
  return total;
}

// e^x, also of NaN, at least e^-87. x = n ln 2 + rest, where n times the first part of ln 2 is exact.
CLEAR_INLINE Floats exponential(const Floats& x) {
  const Floats bounded = minimum(Floats(89.0f), maximum(Floats(-87.0f), x)), log2_e = 1.44269504f;
  const Floats n = nearest(bounded * log2_e);
  const Floats rest = subtract_product(subtract_product(bounded, n, Floats(0.693359375f)), n, Floats(-2.12194440e-4f));
  return scale_by_power(exp2(rest * log2_e), n);
}

}  // namespace clear
