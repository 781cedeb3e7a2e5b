// The gradients of a view's three losses on raw parameters, as a sweep reads them: Gaussian by Gaussian, never in memory.
#pragma once

#include "block.hpp"

namespace clear {

// One cotangent's gradient of the drawn splats (rasterizers.interface.SplatGradients), row-major; colour as its factors.
struct SplatGradient {
  const float *means = nullptr, *quats = nullptr, *scales = nullptr, *opacities = nullptr, *rgb = nullptr;
  const float* basis = nullptr;  // Y [N, bases]
  explicit operator bool() const { return means != nullptr; }
};

// What the chain rule needs of the field as it was drawn (field.Activation).
struct Activation {
  const float *scales, *filtered, *filter, *sigmoid, *factor;
};

struct Gradients {
  std::int64_t n;
  int bases;                     // columns of Y: 1 + active higher bands
  SplatGradient lr, base, hf;    // base and hf may be absent
  Activation activation;
  const float* route;            // m_i, or null for 1
  float lambda_hf;
};

// ∇θ of one loss for sixteen Gaussians. shN stays rank one: Y ⊗ rgb.
struct Pulled {
  Floats means[3], quats[4], scales[3], opacities[1], sh0[3], rgb[3];
};

// Chain rule through the 3D filter, exp and sigmoid; operation by operation field.Activation.pull.
CLEAR_INLINE void pull(const SplatGradient& g, const Activation& a, int bases, std::int64_t i, int count, Pulled& out) {
  load_columns(g.means + 3 * i, count, out.means);
  load_columns(g.quats + 4 * i, count, out.quats);
  load_columns(g.scales + 3 * i, count, out.scales);
  load_columns(g.rgb + 3 * i, count, out.rgb);
  Floats d_opacity = load_some(g.opacities + i, count);
  Floats filter = load_some(a.filter + i, count), sigmoid = load_some(a.sigmoid + i, count);
  Floats factor = load_some(a.factor + i, count);
  Floats s[3], filtered[3], Y0[1];
  load_columns(a.scales + 3 * i, count, s);
  load_columns(a.filtered + 3 * i, count, filtered);
  load_columns(g.basis + bases * i, count, Y0, bases);
  Floats pulls = d_opacity * (factor * sigmoid);  // log(coefficient) grows with log(s) by f² / (s² + f²)
  for (int k = 0; k < 3; ++k) {
    Floats share = filter / filtered[k];
    out.scales[k] = out.scales[k] * (s[k] * s[k]) / filtered[k] + pulls * (share * share);
    out.sh0[k] = Y0[0] * out.rgb[k];
  }
  out.opacities[0] = d_opacity * factor * sigmoid * (1.0f - sigmoid);
}

// The factors ⟨Y_a, Y_b⟩ over the higher bands, for ⟨Y_a ⊗ a, Y_b ⊗ b⟩ = ⟨Y_a, Y_b⟩ ⟨a, b⟩.
struct BasisProducts {
  Doubles lr2, hr2, cross;
};

CLEAR_INLINE BasisProducts basis_products(const float* lr, const float* hr, int bases, std::int64_t i, int count) {
  double l2[kLanes] = {}, h2[kLanes] = {}, cross[kLanes] = {};
  for (int row = 0; row < count; ++row) {
    const float *a = lr + bases * (i + row), *b = hr + bases * (i + row);
    double aa = 0, bb = 0, ab = 0;
    for (int k = 1; k < bases; ++k) {
      aa += double(a[k]) * a[k];
      bb += double(b[k]) * b[k];
      ab += double(a[k]) * b[k];
    }
    l2[row] = aa, h2[row] = bb, cross[row] = ab;
  }
  return {Doubles::load(l2), Doubles::load(h2), Doubles::load(cross)};
}

// g^HR = g_base + λ_HF m g_HF, in the order in which the conductor multiplies.
template <int D>
CLEAR_INLINE void route(Floats (&base)[D], const Floats (&hf)[D], const Floats& m, const Floats& lambda_hf) {
  for (int d = 0; d < D; ++d) base[d] += hf[d] * m * lambda_hf;  // Eq. 13
}

// Sixteen Gaussians' gradients of one view; `hr` is g^HR, routed.
struct Block {
  Pulled lr, hr, hf;
  Floats m;
};

CLEAR_INLINE void load(const Gradients& g, std::int64_t i, int count, Block& b) {
  pull(g.lr, g.activation, g.bases, i, count, b.lr);
  if (!g.base) return;
  pull(g.base, g.activation, g.bases, i, count, b.hr);
  if (!g.hf) return;
  pull(g.hf, g.activation, g.bases, i, count, b.hf);
  b.m = g.route ? load_some(g.route + i, count) : Floats(1.0f);
  route(b.hr.means, b.hf.means, b.m, g.lambda_hf);
  route(b.hr.quats, b.hf.quats, b.m, g.lambda_hf);
  route(b.hr.scales, b.hf.scales, b.m, g.lambda_hf);
  route(b.hr.opacities, b.hf.opacities, b.m, g.lambda_hf);
  route(b.hr.sh0, b.hf.sh0, b.m, g.lambda_hf);
  route(b.hr.rgb, b.hf.rgb, b.m, g.lambda_hf);
}

}  // namespace clear
