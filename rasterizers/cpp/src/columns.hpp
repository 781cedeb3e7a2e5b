// Converts between tensors (a Gaussian per row) and lanes (a Gaussian per lane). A group is sixteen consecutive rows.
#pragma once

#include <algorithm>

#include "rows.hpp"
#include "types.hpp"

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

template <int C, class T>
CLEAR_INLINE void store_rows(T* tensor, std::int64_t row, int count, const Lanes<T> (&columns)[C]) {
  T joined[C * kLanes];
  T* p = count == kLanes ? tensor + row * C : joined;
  join_rows(p, columns);
  if (count < kLanes) std::memcpy(tensor + row * C, joined, sizeof(T) * C * count);
}

template <class T>
CLEAR_INLINE Lanes<T> load_row(const T* tensor, std::int64_t row, int count) {
  Lanes<T> columns[1];
  load_rows<1>(tensor, row, count, columns);
  return columns[0];
}

// Columns of sixteen rows of `width` numbers at arbitrary addresses; a null row is zeros. Does not read beyond a row.
template <class T>
CLEAR_INLINE void gather_rows(const T* const (&rows)[kLanes], int width, Lanes<T>* columns) {
  for (int start = 0; start < width; start += kLanes) {
    int first = std::max(0, std::min(start, width - kLanes));  // the last sixteen overlap the previous ones
    Lanes<T> block[kLanes];
    for (int i = 0; i < kLanes; ++i) {
      if (!rows[i]) {
        block[i] = T(0);
      } else if (width >= kLanes) {
        block[i] = Lanes<T>::load(rows[i] + first);
      } else {
        T padded[kLanes] = {};
        std::copy(rows[i], rows[i] + width, padded);
        block[i] = Lanes<T>::load(padded);
      }
    }
    transpose(block);
    for (int c = start - first; c < kLanes && first + c < width; ++c) columns[first + c] = block[c];
  }
}

// Writes the bits as bools.
inline void store_bits(bool* out, int count, std::uint32_t bits) {
  for (int i = 0; i < count; ++i) out[i] = (bits >> i) & 1;
}

}  // namespace clear
