// The per-Gaussian step of one iteration: a pass for the inner products of both gradients, and, once their weights are known, one
// that merges and applies Adam.
//
// Both compute the gradients from their factors, which is cheaper than storing 59 numbers for each of both scales.
// Sums are taken by chunk of Gaussians and added in the order of the chunks: the same bits for any number of threads.
#pragma once

#include "adam.hpp"
#include "products.hpp"

namespace clear {

struct Step {
  Attribute means, quats, scales, opacities, sh0, shN, detail;
  AdamStep adam;
  float lambda_hr;
  bool skips = true;  // skip rows that would not change
  int width = 0;      // numbers of an shN row that are stepped, a multiple of 3: the active bands', or all
};

// Writes the inner products of g_LR and g^HR, and counts conflicts.
Conflicts products(const Gradients& g, ProductTable to, int threads);

// Steps every attribute in place; returns the number of rows that were skipped, because they would not change.
std::int64_t step(const Gradients& g, const Weights& w, const Step& s, int threads);

}  // namespace clear
