// Rows whose neighbours along the row lie in whole vectors, as neighbours down a column do.
//
// A row is cut into sixteen segments of equal length, one per lane: vector v holds number v of each segment. A step along the
// row is then a step from vector to vector, and no load crosses a cache line. Beyond the ends of its segment a lane continues
// in the neighbouring segment, so a row has copies of those vectors, shifted by a lane; beyond the row there are zeros.
//
// A row holds several quantities, which are read together: those of vector 0, then those of vector 1, and so on.
#pragma once

#include <algorithm>
#include <cstring>

#include "rows.hpp"

namespace clear {

template <int Quantities, int Beyond>
struct Segments {
  static constexpr int kStep = Quantities * kLanes;  // from a vector to the next
  static constexpr std::ptrdiff_t kFirst = std::ptrdiff_t(Beyond) * kStep;  // the place of vector 0 in a row's memory

  static std::size_t floats(int length) { return std::size_t(length + 2 * Beyond) * kStep; }

  // Converts 16 · length numbers to one quantity of a row; `length` is at least sixteen.
  static void cut(const float* numbers, int length, int quantity, float* row) {
    each_square(length, [&](int v, int lane) CLEAR_LAMBDA {
      FloatRegister square[kWidth];
      for (int i = 0; i < kWidth; ++i) std::memcpy(&square[i], numbers + (lane + i) * length + v, sizeof square[i]);
      transpose_square(square);
      float* to = row + v * kStep + quantity * kLanes + lane;
      for (int i = 0; i < kWidth; ++i) std::memcpy(to + i * kStep, &square[i], sizeof square[i]);
    });
  }

  // … and back.
  static void join(const float* row, int length, int quantity, float* numbers) {
    each_square(length, [&](int v, int lane) CLEAR_LAMBDA {
      FloatRegister square[kWidth];
      const float* from = row + v * kStep + quantity * kLanes + lane;
      for (int i = 0; i < kWidth; ++i) std::memcpy(&square[i], from + i * kStep, sizeof square[i]);
      transpose_square(square);
      for (int i = 0; i < kWidth; ++i) std::memcpy(numbers + (lane + i) * length + v, &square[i], sizeof square[i]);
    });
  }

  // Writes the copies beyond the ends of the segments.
  static void continue_ends(float* row, int length) {
    float *before = row - kFirst, *after = row + std::ptrdiff_t(length) * kStep;
    std::memcpy(before, after - kFirst - 1, sizeof(float) * kFirst);
    std::memcpy(after, row + 1, sizeof(float) * kFirst);
    for (int i = 0; i < kFirst; i += kLanes) before[i] = after[i + kLanes - 1] = 0.0f;
  }

 private:
  static constexpr int kWidth = Native<float>::width;

  // The squares of kWidth vectors and as many lanes; the last ones overlap the previous ones.
  template <class Visit>
  static CLEAR_INLINE void each_square(int length, Visit&& visit) {
    for (int v = 0; v < length; v += kWidth)
      for (int lane = 0; lane < kLanes; lane += kWidth) visit(std::min(v, length - kWidth), lane);
  }
};

}  // namespace clear
