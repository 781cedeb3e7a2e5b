// For trainers that have their own optimizer: gradients of the raw parameters in, their products or the merged gradient out, in one
// pass over the Gaussians each. `kernels/reconcile/reference.py` specifies both.
#pragma once

#include <vector>

#include "products.hpp"

namespace clear {

// One attribute's gradients [n, width]; a pointer may be null, which is 0.
struct Rows {
  const float *lr, *hr;  // for spherical harmonics in addition to what `TwoGradients` has of them as colours
  int width, group;      // group: kGroups for f_det, which is compared with nothing
  int first_band;        // of the spherical harmonics; -1: none
  const float* plus;     // what is added to the merged gradient
  float* out;            // receives it; may be `lr`
};

// A gradient of the spherical harmonics, Y ⊗ ∇rgb, by its factors [n, 3] and [n, bases]; none where rgb is null.
struct Colour {
  const float *rgb = nullptr, *basis = nullptr;
  int bases = 1;
};

struct TwoGradients {
  std::int64_t n;
  std::vector<Rows> attributes;
  Colour lr, hr;
};

constexpr int kWidest = 45;  // three degrees of spherical harmonics

// Writes the inner products of both gradients, and counts conflicts.
Conflicts products(const TwoGradients& g, ProductTable to, int threads);

// out = g_LR + λ_HR (keep · g_HR - remove · g_LR) + plus for every attribute; without `keeps_lr` the term in parentheses alone.
// Returns whether every number of the result is finite.
bool apply(const TwoGradients& g, const Weights& w, float lambda_hr, bool keeps_lr, int threads);

}  // namespace clear
