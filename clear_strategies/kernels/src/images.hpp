// The images that a loss compares. Channels are interleaved: a row is W · 3 numbers.
#pragma once

namespace clear {

inline constexpr int kChannels = 3;

struct ImagePair {
  const float *x, *y;
  float* gradient;  // of the loss, with respect to x
  int height, row;  // row: numbers in a row, W · 3
};

}  // namespace clear
