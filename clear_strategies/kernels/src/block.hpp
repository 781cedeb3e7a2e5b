// Sixteen Gaussians at a time: from rows in memory to lanes and back.
#pragma once

#include <cstdint>

#include "simd.hpp"

namespace clear {

using Floats = Lanes<float>;
using Doubles = Lanes<double>;

#if defined(__AVX512F__)
// Indices that pick number D · i + d out of D registers in a row, two registers at a time, and the way back.
template <int D>
struct Interleaving {
  alignas(64) std::int32_t apart[D][D - 1][kLanes], together[D][D - 1][kLanes];

  constexpr Interleaving() : apart{}, together{} {
    for (int out = 0; out < D; ++out)
      for (int i = 0; i < kLanes; ++i) {
        int p = D * i + out, q = kLanes * out + i;  // where column `out` reads, and what register `out` of the rows holds
        for (int k = 1; k < D; ++k) {
          apart[out][k - 1][i] = p / kLanes == k ? kLanes + p % kLanes : k == 1 ? p % kLanes : i;
          together[out][k - 1][i] = q % D == k ? kLanes + q / D : k == 1 ? q / D : i;
        }
      }
  }
};

template <int D>
CLEAR_INLINE void rearrange(const std::int32_t (&indices)[D][D - 1][kLanes], const __m512 (&in)[D], __m512 (&out)[D]) {
  for (int d = 0; d < D; ++d) {
    out[d] = in[0];
    for (int k = 1; k < D; ++k) out[d] = _mm512_permutex2var_ps(out[d], _mm512_load_si512(indices[d][k - 1]), in[k]);
  }
}

template <int D>
inline constexpr Interleaving<D> kInterleaving;
#endif

// columns[d] lane i = rows[i · stride + d] for the first `count` rows; lanes beyond are 0.
template <int D>
CLEAR_INLINE void load_columns(const float* rows, int count, Floats (&columns)[D], int stride = D) {
#if defined(__AVX512F__)
  if constexpr (D == 3 || D == 4) {
    if (count == kLanes && stride == D) {
      __m512 in[D], out[D];
      for (int d = 0; d < D; ++d) in[d] = _mm512_loadu_ps(rows + kLanes * d);
      rearrange<D>(kInterleaving<D>.apart, in, out);
      for (int d = 0; d < D; ++d) columns[d].r[0] = (Floats::Register)out[d];
      return;
    }
  }
#endif
  float a[D][kLanes] = {};
  for (int i = 0; i < count; ++i)
    for (int d = 0; d < D; ++d) a[d][i] = rows[std::int64_t(i) * stride + d];
  for (int d = 0; d < D; ++d) columns[d] = Floats::load(a[d]);
}

template <int D>
CLEAR_INLINE void store_columns(float* rows, const Floats (&columns)[D]) {
#if defined(__AVX512F__)
  if constexpr (D == 3 || D == 4) {
    __m512 in[D], out[D];
    for (int d = 0; d < D; ++d) in[d] = (__m512)columns[d].r[0];
    rearrange<D>(kInterleaving<D>.together, in, out);
    for (int d = 0; d < D; ++d) _mm512_storeu_ps(rows + kLanes * d, out[d]);
    return;
  }
#endif
  float a[D][kLanes];
  for (int d = 0; d < D; ++d) columns[d].store(a[d]);
  for (int i = 0; i < kLanes; ++i)
    for (int d = 0; d < D; ++d) rows[i * D + d] = a[d][i];
}

CLEAR_INLINE Floats load_some(const float* values, int count) {
  if (count == kLanes) return Floats::load(values);
  float a[kLanes] = {};
  for (int i = 0; i < count; ++i) a[i] = values[i];
  return Floats::load(a);
}

CLEAR_INLINE Doubles widen(const Floats& a) {
  typedef float Sixteen __attribute__((vector_size(4 * kLanes)));
  typedef double Wide __attribute__((vector_size(8 * kLanes)));
  Sixteen f;
  std::memcpy(&f, a.r, sizeof f);
  Wide d = __builtin_convertvector(f, Wide);
  Doubles out;
  std::memcpy(out.r, &d, sizeof d);
  return out;
}

CLEAR_INLINE Floats narrow(const Doubles& a) {
  typedef float Sixteen __attribute__((vector_size(4 * kLanes)));
  typedef double Wide __attribute__((vector_size(8 * kLanes)));
  Wide d;
  std::memcpy(&d, a.r, sizeof d);
  Sixteen f = __builtin_convertvector(d, Sixteen);
  Floats out;
  std::memcpy(out.r, &f, sizeof f);
  return out;
}

CLEAR_INLINE double sum(const Doubles& a) {
  double values[kLanes], total = 0;
  a.store(values);
  for (double value : values) total += value;
  return total;
}

// a · b + c, rounded once where the processor can: torch's add_(alpha) and addcmul_ do the same.
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

// Lane i = table[indices[i]], indices in 0 … 15.
CLEAR_INLINE Floats pick(const Floats& table, const std::int32_t* indices) {
#if defined(__AVX512F__)
  Floats out;
  out.r[0] = (Floats::Register)_mm512_permutexvar_ps(_mm512_loadu_si512(indices), (__m512)table.r[0]);
  return out;
#else
  float a[kLanes], b[kLanes];
  table.store(a);
  for (int i = 0; i < kLanes; ++i) b[i] = a[indices[i]];
  return Floats::load(b);
#endif
}

}  // namespace clear
