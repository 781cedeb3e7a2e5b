// Loads sixteen Gaussians from rows in memory into lanes, and arithmetic that only the trainer's kernels need.
#pragma once

#include <cstdint>
#include <initializer_list>

#include "rows.hpp"

namespace clear {

using Floats = Lanes<float>;
using Doubles = Lanes<double>;

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

// a · b + c, rounded once where the processor has FMA, as torch's add_(alpha) and addcmul_ do.
CLEAR_INLINE Floats multiply_add(const Floats& a, const Floats& b, const Floats& c) {
#if defined(__AVX512F__)
  Floats out;
  out.r[0] = (Floats::Register)_mm512_fmadd_ps((__m512)a.r[0], (__m512)b.r[0], (__m512)c.r[0]);
  return out;
#elif defined(__FMA__)
  Floats out;
  for (int i = 0; i < Floats::registers; ++i)
    out.r[i] = (Floats::Register)_mm256_fmadd_ps((__m256)a.r[i], (__m256)b.r[i], (__m256)c.r[i]);
  return out;
#else
  return a * b + c;
#endif
}

}  // namespace clear
