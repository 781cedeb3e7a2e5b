// Moves numbers between rows and lanes: transposes, interleaved rows such as xyzxyz…, and small tables.
//
// The building block is the quad: 16 bytes of a register, four floats. Every processor shuffles two registers quad by quad
// in one instruction, whatever their width; moving whole quads between registers is the rest. Double, which is for checking,
// goes through memory.
#pragma once

#include "simd.hpp"

namespace clear {

inline constexpr int kQuad = 4;
inline constexpr int kQuads = kRegisterBytes / 16;  // per register

using FloatRegister = Native<float>::Register;

// In every quad: (a[i], a[j], b[k], b[l]).
struct WithinQuads {
  template <int i, int j, int k, int l>
  static CLEAR_INLINE FloatRegister shuffle(FloatRegister a, FloatRegister b) {
#if defined(__AVX512F__)
    return (FloatRegister)_mm512_shuffle_ps((__m512)a, (__m512)b, i | j << 2 | k << 4 | l << 6);
#elif defined(__AVX2__)
    return (FloatRegister)_mm256_shuffle_ps((__m256)a, (__m256)b, i | j << 2 | k << 4 | l << 6);
#elif defined(__SSE2__)
    return (FloatRegister)_mm_shuffle_ps((__m128)a, (__m128)b, i | j << 2 | k << 4 | l << 6);
#elif defined(__clang__)
    return __builtin_shufflevector(a, b, i, j, k + kQuad, l + kQuad);
#else
    return __builtin_shuffle(a, b, Native<float>::Integer{i, j, k + kQuad, l + kQuad});
#endif
  }
};

#if defined(__AVX512F__)
// The same with whole quads in place of numbers.
struct OfQuads {
  template <int i, int j, int k, int l>
  static CLEAR_INLINE FloatRegister shuffle(FloatRegister a, FloatRegister b) {
    return (FloatRegister)_mm512_shuffle_f32x4((__m512)a, (__m512)b, i | j << 2 | k << 4 | l << 6);
  }
};
#endif

// Transposes a 4 x 4 matrix whose rows are a, b, c, d: one of numbers in each quad, or one of quads.
template <class Matrix>
CLEAR_INLINE void transpose_four(FloatRegister& a, FloatRegister& b, FloatRegister& c, FloatRegister& d) {
  const FloatRegister ab0 = Matrix::template shuffle<0, 1, 0, 1>(a, b), ab2 = Matrix::template shuffle<2, 3, 2, 3>(a, b);
  const FloatRegister cd0 = Matrix::template shuffle<0, 1, 0, 1>(c, d), cd2 = Matrix::template shuffle<2, 3, 2, 3>(c, d);
  a = Matrix::template shuffle<0, 2, 0, 2>(ab0, cd0), b = Matrix::template shuffle<1, 3, 1, 3>(ab0, cd0);
  c = Matrix::template shuffle<0, 2, 0, 2>(ab2, cd2), d = Matrix::template shuffle<1, 3, 1, 3>(ab2, cd2);
}

// In every quad: the sum of a's four numbers, of b's, c's and d's.
CLEAR_INLINE FloatRegister sum_quads(FloatRegister a, FloatRegister b, FloatRegister c, FloatRegister d) {
  using Q = WithinQuads;
  const FloatRegister ab = Q::shuffle<0, 2, 0, 2>(a, b) + Q::shuffle<1, 3, 1, 3>(a, b);
  const FloatRegister cd = Q::shuffle<0, 2, 0, 2>(c, d) + Q::shuffle<1, 3, 1, 3>(c, d);
  return Q::shuffle<0, 2, 0, 2>(ab, cd) + Q::shuffle<1, 3, 1, 3>(ab, cd);
}

// Transposes a square of kRegisterBytes / 4 rows, one register each.
CLEAR_INLINE void transpose_square(FloatRegister (&rows)[Native<float>::width]) {
  for (int i = 0; i < kQuads; ++i)
    transpose_four<WithinQuads>(rows[4 * i], rows[4 * i + 1], rows[4 * i + 2], rows[4 * i + 3]);
  // Quad q of rows[4 i + c] is now quad i of the transpose's row 4 q + c.
#if defined(__AVX512F__)
  for (int c = 0; c < kQuad; ++c) transpose_four<OfQuads>(rows[c], rows[4 + c], rows[8 + c], rows[12 + c]);
#elif defined(__AVX2__)
  for (int c = 0; c < kQuad; ++c) {
    const __m256 a = (__m256)rows[c], b = (__m256)rows[4 + c];
    rows[c] = (FloatRegister)_mm256_permute2f128_ps(a, b, 0x20);
    rows[4 + c] = (FloatRegister)_mm256_permute2f128_ps(a, b, 0x31);
  }
#endif
}

#if !defined(__AVX512F__)
// Adds to p[0 … 3] the sum of a's quads, and to p[4 … 7] that of b's.
CLEAR_INLINE void add_quads(float* p, FloatRegister a, FloatRegister b) {
#if defined(__AVX2__)
  const __m256 crossed = _mm256_permute2f128_ps((__m256)a, (__m256)b, 0x21);  // a's upper quad, b's lower one
  const __m256 both = _mm256_add_ps(_mm256_blend_ps((__m256)a, (__m256)b, 0xf0), crossed);
  _mm256_storeu_ps(p, _mm256_add_ps(_mm256_loadu_ps(p), both));
#else
  FloatRegister row[2];
  std::memcpy(row, p, sizeof row);
  row[0] += a, row[1] += b;
  std::memcpy(p, row, sizeof row);
#endif
}

// Adds the sum of a's quads to p[0 … 3].
CLEAR_INLINE void add_quad(float* p, FloatRegister a) {
#if defined(__AVX2__)
  const __m128 sum = _mm_add_ps(_mm256_castps256_ps128((__m256)a), _mm256_extractf128_ps((__m256)a, 1));
  _mm_storeu_ps(p, _mm_add_ps(_mm_loadu_ps(p), sum));
#else
  FloatRegister row;
  std::memcpy(&row, p, sizeof row);
  row += a;
  std::memcpy(p, &row, sizeof row);
#endif
}
#endif

// Transposes in place: rows[i] lane j  <->  rows[j] lane i.
template <class T>
CLEAR_INLINE void transpose(Lanes<T> (&rows)[kLanes]) {
  if constexpr (sizeof(T) == 4) {
    constexpr int width = Native<T>::width, squares = Lanes<T>::registers;
    auto transposed = [&](int y, int x, FloatRegister (&square)[width]) CLEAR_LAMBDA {
      for (int i = 0; i < width; ++i) square[i] = rows[width * y + i].r[x];
      transpose_square(square);
    };
    auto store = [&](int y, int x, const FloatRegister (&square)[width]) CLEAR_LAMBDA {
      for (int i = 0; i < width; ++i) rows[width * y + i].r[x] = square[i];
    };
    for (int y = 0; y < squares; ++y)
      for (int x = 0; x <= y; ++x) {
        FloatRegister here[width], there[width];
        transposed(y, x, here);
        if (x < y) transposed(x, y, there), store(y, x, there);
        store(x, y, here);
      }
  } else {
    T a[kLanes][kLanes], b[kLanes][kLanes];
    for (int i = 0; i < kLanes; ++i) rows[i].store(a[i]);
    for (int i = 0; i < kLanes; ++i)
      for (int j = 0; j < kLanes; ++j) b[j][i] = a[i][j];
    for (int i = 0; i < kLanes; ++i) rows[i] = Lanes<T>::load(b[i]);
  }
}

// The register whose quad q is the four numbers at p + q · stride.
CLEAR_INLINE FloatRegister load_quads(const float* p, [[maybe_unused]] std::ptrdiff_t stride) {
#if defined(__AVX512F__)
  const __m512 two = _mm512_insertf32x4(_mm512_castps128_ps512(_mm_loadu_ps(p)), _mm_loadu_ps(p + stride), 1);
  return _mm512_insertf32x4(_mm512_insertf32x4(two, _mm_loadu_ps(p + 2 * stride), 2), _mm_loadu_ps(p + 3 * stride), 3);
#elif defined(__AVX2__)
  return (FloatRegister)_mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p)), _mm_loadu_ps(p + stride), 1);
#else
  FloatRegister out;
  std::memcpy(&out, p, sizeof out);
  return out;
#endif
}

CLEAR_INLINE void store_quads(float* p, [[maybe_unused]] std::ptrdiff_t stride, FloatRegister a) {
#if defined(__AVX512F__)
  _mm_storeu_ps(p, _mm512_castps512_ps128(a)), _mm_storeu_ps(p + stride, _mm512_extractf32x4_ps(a, 1));
  _mm_storeu_ps(p + 2 * stride, _mm512_extractf32x4_ps(a, 2)), _mm_storeu_ps(p + 3 * stride, _mm512_extractf32x4_ps(a, 3));
#elif defined(__AVX2__)
  _mm_storeu_ps(p, _mm256_castps256_ps128((__m256)a));
  _mm_storeu_ps(p + stride, _mm256_extractf128_ps((__m256)a, 1));
#else
  std::memcpy(p, &a, sizeof a);
#endif
}

// In every quad: four rows of D numbers, one after the other, become four numbers of each of D columns.
template <int D>
CLEAR_INLINE void split_quads(FloatRegister (&r)[D]) {
  using Q = WithinQuads;
  if constexpr (D == 2) {
    const FloatRegister even = Q::shuffle<0, 2, 0, 2>(r[0], r[1]);
    r[1] = Q::shuffle<1, 3, 1, 3>(r[0], r[1]), r[0] = even;
  } else if constexpr (D == 3) {  // x0 y0 z0 x1 | y1 z1 x2 y2 | z2 x3 y3 z3
    const FloatRegister xy = Q::shuffle<2, 3, 1, 2>(r[1], r[2]), yz = Q::shuffle<1, 2, 0, 1>(r[0], r[1]);
    r[0] = Q::shuffle<0, 3, 0, 2>(r[0], xy), r[1] = Q::shuffle<0, 2, 1, 3>(yz, xy), r[2] = Q::shuffle<1, 3, 0, 3>(yz, r[2]);
  } else if constexpr (D == 4) {
    transpose_four<Q>(r[0], r[1], r[2], r[3]);
  }
}

// … and back.
template <int D>
CLEAR_INLINE void join_quads(FloatRegister (&r)[D]) {
  using Q = WithinQuads;
  if constexpr (D == 2) {
    const FloatRegister even = Q::shuffle<0, 2, 0, 2>(r[0], r[1]), odd = Q::shuffle<1, 3, 1, 3>(r[0], r[1]);
    r[0] = Q::shuffle<0, 2, 0, 2>(even, odd), r[1] = Q::shuffle<1, 3, 1, 3>(even, odd);
  } else if constexpr (D == 3) {
    const FloatRegister xy = Q::shuffle<0, 2, 0, 2>(r[0], r[1]), yz = Q::shuffle<1, 3, 1, 3>(r[1], r[2]);
    const FloatRegister zx = Q::shuffle<0, 2, 1, 3>(r[2], r[0]);
    r[0] = Q::shuffle<0, 2, 0, 2>(xy, zx), r[1] = Q::shuffle<0, 2, 1, 3>(yz, xy), r[2] = Q::shuffle<1, 3, 1, 3>(zx, yz);
  } else if constexpr (D == 4) {
    transpose_four<Q>(r[0], r[1], r[2], r[3]);
  }
}

// Converts sixteen rows of D numbers, four each at p, p + stride, p + 2 stride and p + 3 stride, to D columns of sixteen.
template <int D>
CLEAR_INLINE void split_rows(const float* p, std::ptrdiff_t stride, Lanes<float> (&columns)[D]) {
  for (int k = 0; k < Lanes<float>::registers; ++k) {
    FloatRegister r[D];
    for (int d = 0; d < D; ++d) r[d] = load_quads(p + kQuads * k * stride + kQuad * d, stride);
    split_quads(r);
    for (int d = 0; d < D; ++d) columns[d].r[k] = r[d];
  }
}

// … and back.
template <int D>
CLEAR_INLINE void join_rows(float* p, std::ptrdiff_t stride, const Lanes<float> (&columns)[D]) {
  for (int k = 0; k < Lanes<float>::registers; ++k) {
    FloatRegister r[D];
    for (int d = 0; d < D; ++d) r[d] = columns[d].r[k];
    join_quads(r);
    for (int d = 0; d < D; ++d) store_quads(p + kQuads * k * stride + kQuad * d, stride, r[d]);
  }
}

template <int D, class T>
inline constexpr bool kInQuads = sizeof(T) == 4 && D >= 2 && D <= 4;

// The same of contiguous rows.
template <int D, class T>
CLEAR_INLINE void split_rows(const T* rows, Lanes<T> (&columns)[D]) {
  if constexpr (D == 1) {
    columns[0] = Lanes<T>::load(rows);
  } else if constexpr (kInQuads<D, T>) {
    split_rows(rows, kQuad * D, columns);
  } else {
    T split[D][kLanes];
    for (int i = 0; i < kLanes; ++i)
      for (int d = 0; d < D; ++d) split[d][i] = rows[D * i + d];
    for (int d = 0; d < D; ++d) columns[d] = Lanes<T>::load(split[d]);
  }
}

template <int D, class T>
CLEAR_INLINE void join_rows(T* rows, const Lanes<T> (&columns)[D]) {
  if constexpr (D == 1) {
    columns[0].store(rows);
  } else if constexpr (kInQuads<D, T>) {
    join_rows(rows, kQuad * D, columns);
  } else {
    T split[D][kLanes];
    for (int d = 0; d < D; ++d) columns[d].store(split[d]);
    for (int i = 0; i < kLanes; ++i)
      for (int d = 0; d < D; ++d) rows[D * i + d] = split[d][i];
  }
}

// Columns to the `count` (1 … 16) rows from `row` on of a contiguous [n, C] tensor.
template <int C, class T>
CLEAR_INLINE void store_rows(T* tensor, std::int64_t row, int count, const Lanes<T> (&columns)[C]) {
  T joined[C * kLanes];
  T* p = count == kLanes ? tensor + row * C : joined;
  join_rows(p, columns);
  if (count < kLanes) std::memcpy(tensor + row * C, joined, sizeof(T) * C * count);
}

// Lane i = table[indices[i]], indices in 0 … 15.
CLEAR_INLINE Lanes<float> pick(const Lanes<float>& table, const std::int32_t* indices) {
#if defined(__AVX512F__)
  Lanes<float> out;
  out.r[0] = (FloatRegister)_mm512_permutexvar_ps(_mm512_loadu_si512(indices), (__m512)table.r[0]);
  return out;
#elif defined(__AVX2__)
  Lanes<float> out;
  for (int k = 0; k < Lanes<float>::registers; ++k) {
    const __m256i at = _mm256_loadu_si256((const __m256i*)(indices + 8 * k));
    const __m256 low = _mm256_permutevar8x32_ps((__m256)table.r[0], at);
    const __m256 high = _mm256_permutevar8x32_ps((__m256)table.r[1], at);
    out.r[k] = (FloatRegister)_mm256_blendv_ps(low, high, (__m256)_mm256_slli_epi32(at, 28));  // 8 … 15: the sign bit
  }
  return out;
#else
  float a[kLanes], b[kLanes];
  table.store(a);
  for (int i = 0; i < kLanes; ++i) b[i] = a[indices[i]];
  return Lanes<float>::load(b);
#endif
}

}  // namespace clear
