// The per-Gaussian step of one iteration, in one pass over the Gaussians: it counts conflicts, merges, corrects, adds the anchor's
// gradient, and applies Adam.
//
// It computes the gradients from their factors, which is cheaper than storing 59 numbers for each of three losses.
// Sums are taken by chunk of Gaussians and added in the order of the chunks: the same bits for any number of threads.
#pragma once

#include "adam.hpp"
#include "conflict.hpp"

namespace clear {

struct Step {
  Attribute means, quats, scales, opacities, sh0, shN, detail;
  AdamStep adam;
  float lambda_hr;
  bool skips = true;  // skip rows that would not change
  int width = 0;      // numbers of an shN row that are stepped, a multiple of 3: the active bands', or all
};

struct Stepped {
  Conflicts conflicts;
  std::int64_t still = 0;  // rows that were skipped, because they would not change
};

// Steps every attribute in place, or writes its merged gradient where `merged` is set.
Stepped step(const Gradients& g, const Correction* correction, const Step& s, int threads);

}  // namespace clear
