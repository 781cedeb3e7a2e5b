// Converts between tensors (a Gaussian per row) and lanes (a Gaussian per lane). A group is sixteen consecutive rows.
#pragma once

#include <algorithm>

#include "groups.hpp"
#include "rows.hpp"

namespace clear {

// Columns of a contiguous [n, C] tensor, for the `count` (1 … 16) rows from `row` on; the last row is repeated to sixteen.
template <int C, class T>
CLEAR_INLINE void load_rows(const T* tensor, std::int64_t row, int count, Lanes<T> (&columns)[C]) {
  const T* p = tensor + row * C;
  T padded[C * kLanes];
  if (count < kLanes) {
    for (int i = 0; i < kLanes; ++i)
      for (int c = 0; c < C; ++c) padded[C * i + c] = p[C * std::min(i, count - 1) + c];
    p = padded;
  }
  split_rows(p, columns);
}

// The same for the rows of a group's Gaussians.
template <int C, class T>
CLEAR_INLINE void load_rows(const T* tensor, const Group& group, Lanes<T> (&columns)[C]) {
  if (group.consecutive) return load_rows<C>(tensor, group.rows[0], group.count, columns);
  T apart[C][kLanes];
  for (int i = 0; i < kLanes; ++i)
    for (int c = 0; c < C; ++c) apart[c][i] = tensor[std::int64_t(C) * group.rows[i] + c];
  for (int c = 0; c < C; ++c) columns[c] = Lanes<T>::load(apart[c]);
}

template <int C, class T>
CLEAR_INLINE void store_rows(T* tensor, const Group& group, const Lanes<T> (&columns)[C]) {
  if (group.consecutive) return store_rows<C>(tensor, group.rows[0], group.count, columns);
  T joined[C * kLanes];
  join_rows(joined, columns);
  for (int i = 0; i < group.count; ++i)
    std::memcpy(tensor + std::int64_t(C) * group.rows[i], joined + C * i, sizeof(T) * C);
}

// Columns of a group's rows of `width` numbers, `stride` apart, in place: there is room for at least sixteen. Does
// not read beyond a row.
template <class T>
CLEAR_INLINE void load_rows(const T* tensor, std::int64_t stride, const Group& group, int width, Lanes<T>* columns) {
  for (int start = 0; start < width; start += kLanes) {
    const int first = std::max(0, std::min(start, width - kLanes));  // the last sixteen overlap the previous ones
    auto& block = reinterpret_cast<Lanes<T>(&)[kLanes]>(columns[first]);
    for (int i = 0; i < kLanes; ++i) {
      const T* row = tensor + stride * group.rows[i] + first;
      if (width >= kLanes) {
        block[i] = Lanes<T>::load(row);
      } else {
        T padded[kLanes] = {};
        std::copy(row, row + width, padded);
        block[i] = Lanes<T>::load(padded);
      }
    }
    transpose(block);
  }
}

// The lanes in whose byte the bit is set.
CLEAR_INLINE std::uint32_t lanes_with_bit(const std::uint8_t (&bytes)[kLanes], int bit) {
#if defined(__SSE2__)
  return std::uint32_t(_mm_movemask_epi8(_mm_slli_epi16(_mm_loadu_si128(reinterpret_cast<const __m128i*>(bytes)), 7 - bit)));
#else
  std::uint32_t lanes = 0;
  for (int i = 0; i < kLanes; ++i) lanes |= std::uint32_t(bytes[i] >> bit & 1) << i;
  return lanes;
#endif
}

}  // namespace clear
