// The per-Gaussian pass of one iteration in two sweeps: one that counts, one that merges, corrects, anchors and steps.
//
// Nothing per Gaussian is written in between: both sweeps make the gradients anew from their factors, which is cheaper
// than storing 59 numbers for each of three losses. Every stretch of Gaussians sums for itself, and the sums are added in
// the order of the stretches: the same bits for any number of threads.
#pragma once

#include "adam.hpp"
#include "conflict.hpp"

namespace clear {

struct Step {
  Attribute means, quats, scales, opacities, sh0, shN, detail;
  AdamStep adam;
  float lambda_hr;
  const bool* visible = nullptr;  // rows that may step; null: all
  bool skips = true;              // leave out rows that would not move
  int width = 0;                  // numbers of an shN row to step, a multiple of 3: those of the active bands, or all
};

struct Stepped {
  Corrected corrected;
  std::int64_t still = 0, invisible = 0;  // rows that took no step
};

// Comparable and opposed Gaussians by group. `norm_products` [6, N] takes ‖l‖‖h‖ if it is not null.
Comparison compare(const Gradients& g, double* norm_products, int threads);

// One step of every attribute in place, or, where `merged` is set, its gradient.
Stepped step(const Gradients& g, const Correction* correction, const Step& s, int threads);

}  // namespace clear
