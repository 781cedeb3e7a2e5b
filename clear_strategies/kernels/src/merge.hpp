// The merge for trainers that have their own optimizer: gradients of the raw parameters in, the merged gradient out, in one pass
// over the Gaussians. The rules are those of the trainer's step (conflict.hpp); `Conductor.merge` specifies both.
#pragma once

#include <vector>

#include "conflict.hpp"

namespace clear {

// One attribute's gradients [n, width]; a pointer may be null.
struct MergedRows {
  const float* lr;      // scale · g_LR + before; null: 0; without what `Merge::lr` holds of it
  const float* before;  // what the gradient was before this backward pass; null: 0
  const float* hr;      // g^HR; null: 0, or what `Merge::hr` holds of it
  int first_band;       // of the spherical harmonics; -1: none
  const float *p, *anchor;
  float stiffness;
  float* out;           // may be `lr`
  int width, group;     // group: kGroups for f_det, which is compared with nothing
};

// A gradient of the spherical harmonics, Y ⊗ ∇rgb, by its factors [n, 3] and [n, bases]; none where rgb is null.
struct ColourFactors {
  const float *rgb = nullptr, *basis = nullptr;
  int bases = 1;
};

struct Merge {
  std::int64_t n;
  std::vector<MergedRows> attributes;
  ColourFactors lr, hr;  // that of LR times the scale
  bool keeps_lr = true;  // false: out is the corrected g^HR alone
  float lambda_hr = 0, scale = 1;
};

struct Merged {
  Conflicts conflicts;
  bool finite = true;  // every number of the result
};

constexpr int kWidest = 45;  // three degrees of spherical harmonics

// out = before + scale (g_LR + λ_HR ĝ_HR + stiffness (p - anchor)) for every attribute.
Merged merge(const Merge& m, const Correction* correction, int threads);

}  // namespace clear
