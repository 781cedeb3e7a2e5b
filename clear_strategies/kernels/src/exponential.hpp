// The exponential of sixteen numbers at a time.
#pragma once

#include "simd.hpp"

namespace clear {

// e^x, also of NaN, at least e^-87. x = n ln 2 + rest, where n times the first part of ln 2 is exact.
CLEAR_INLINE Floats exponential(const Floats& x) {
  const Floats bounded = minimum(Floats(89.0f), maximum(Floats(-87.0f), x)), log2_e = 1.44269504f;
  const Floats n = nearest(bounded * log2_e);
  const Floats rest = subtract_product(subtract_product(bounded, n, Floats(0.693359375f)), n, Floats(-2.12194440e-4f));
  return scale_by_power(exp2(rest * log2_e), n);
}

}  // namespace clear
