// Rows of shN as vectors, and as the products Y ⊗ ∇rgb that their gradients are.
#pragma once

#include <algorithm>
#include <cstdint>

#include "block.hpp"

namespace clear {

// The channel and band of each number of an shN row, in up to three groups of sixteen. The last group ends with the row
// and overlaps the previous one; all are read before any is written, so the overlap is written twice with the same values.
struct RowPlan {
  int sixteens, width, offset[3];
  std::int32_t channel[3][kLanes], band[3][kLanes];

  explicit RowPlan(int width) : sixteens((width + kLanes - 1) / kLanes), width(width) {
    for (int k = 0; k < sixteens; ++k) {
      offset[k] = std::max(0, std::min(kLanes * k, width - kLanes));
      for (int j = 0; j < kLanes; ++j) {
        channel[k][j] = (offset[k] + j) % 3;
        band[k][j] = std::min((offset[k] + j) / 3 + 1, kLanes - 1);  // the basis is 0 for inactive bands
      }
    }
  }
};

// Vector v of the row Y ⊗ ∇rgb.
CLEAR_INLINE Floats outer(const Floats& Y, const Floats& rgb, const RowPlan& plan, int v) {
  return pick(Y, plan.band[v]) * pick(rgb, plan.channel[v]);
}

// `count` rows Y ⊗ ∇rgb from the rows of its factors; those beyond, up to sixteen, become 0.
CLEAR_INLINE void expand(const float* rgb_rows, const float* basis, int bases, const RowPlan& plan, int count, float* to) {
  float colour[4 * kLanes] = {};  // padded, because reads are sixteen wide
  std::copy_n(rgb_rows, 3 * count, colour);
  for (int k = 0; k < count; ++k, to += plan.width) {
    const Floats Y = load_some(basis + bases * k, bases), rgb = Floats::load(colour + 3 * k);
    float few[kLanes];  // of a row of less than sixteen numbers
    float* row = plan.width < kLanes ? few : to;
    for (int v = 0; v < plan.sixteens; ++v) outer(Y, rgb, plan, v).store(row + plan.offset[v]);
    if (plan.width < kLanes) std::copy_n(few, plan.width, to);
  }
  std::fill_n(to, (kLanes - count) * plan.width, 0.0f);
}

}  // namespace clear
