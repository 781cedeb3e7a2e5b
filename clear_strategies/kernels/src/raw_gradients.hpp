// The gradients of both scales of a view with respect to the raw parameters, computed per Gaussian and never stored.
#pragma once

#include "block.hpp"

namespace clear {

// One cotangent's rasterizers.interface.SplatGradients, row-major; rgb is the factor beside Y of the colour gradient.
struct SplatGradient {
  const float *means = nullptr, *quats = nullptr, *scales = nullptr, *opacities = nullptr, *rgb = nullptr;
  explicit operator bool() const { return means != nullptr; }
};

// The inputs of the activations' VJP (training.field.Activation).
struct Activation {
  const float *scales, *filtered, *filter, *sigmoid, *factor;
};

struct Gradients {
  std::int64_t n;
  int bases;                     // columns of Y: 1 + active higher bands
  const float* basis;            // Y [N, bases]
  SplatGradient lr, hr;          // of L_LR, and g^HR, which may be absent
  const float* detail;           // m λ_HF ∇L_HF of f_det, or null
  Activation activation;
};

// ∇θ of one loss for sixteen Gaussians. shN's gradient stays in factors: Y ⊗ rgb.
struct RawGradients {
  Floats means[3], quats[4], scales[3], opacities[1], sh0[3], rgb[3];
};

// The part of the activations' VJP for sixteen Gaussians that both gradients share.
struct Activated {
  Floats squares[3], filtered[3], shares[3], sigmoid, factor, opacity, slope;
};

CLEAR_INLINE void load(const Activation& a, std::int64_t i, int count, Activated& out) {
  Floats s[3], filter = load_some(a.filter + i, count);
  load_columns(a.scales + 3 * i, count, s);
  load_columns(a.filtered + 3 * i, count, out.filtered);
  out.sigmoid = load_some(a.sigmoid + i, count);
  out.factor = load_some(a.factor + i, count);
  out.opacity = out.factor * out.sigmoid;
  out.slope = 1.0f - out.sigmoid;
  for (int k = 0; k < 3; ++k) {
    Floats share = filter / out.filtered[k];  // log(coefficient) grows with log(s) by f² / (s² + f²)
    out.shares[k] = share * share;
    out.squares[k] = s[k] * s[k];
  }
}

// The VJP of the 3D filter, exp and sigmoid. Same operations as training.field.Activation.vjp.
CLEAR_INLINE void activation_vjp(const SplatGradient& g, const Activated& a, const Floats& Y0, std::int64_t i, int count, RawGradients& out) {
  load_columns(g.means + 3 * i, count, out.means);
  load_columns(g.quats + 4 * i, count, out.quats);
  load_columns(g.scales + 3 * i, count, out.scales);
  load_columns(g.rgb + 3 * i, count, out.rgb);
  Floats d_opacity = load_some(g.opacities + i, count);
  for (int k = 0; k < 3; ++k) {
    out.scales[k] = out.scales[k] * a.squares[k] / a.filtered[k] + d_opacity * a.opacity * a.shares[k];
    out.sh0[k] = Y0 * out.rgb[k];
  }
  out.opacities[0] = d_opacity * a.factor * a.sigmoid * a.slope;
}

// ‖Y‖² over the higher bands of sixteen Gaussians, for ⟨Y ⊗ a, Y ⊗ b⟩ = ‖Y‖² ⟨a, b⟩.
CLEAR_INLINE Doubles higher_bands2(const float* basis, int bases, std::int64_t i, int count) {
  Doubles total = 0.0;
  if (bases == 1) return total;
  Floats bands[kLanes];
  for (int row = 0; row < kLanes; ++row) bands[row] = row < count ? load_some(basis + bases * (i + row), bases) : Floats(0.0f);
  transpose(bands);
  for (int k = 1; k < bases; ++k) total += widen(bands[k]) * widen(bands[k]);
  return total;
}

// The gradients of sixteen Gaussians for one view.
struct Block {
  RawGradients lr, hr;
  Floats detail[3];
};

CLEAR_INLINE void load(const Gradients& g, std::int64_t i, int count, Block& b) {
  Activated a;
  load(g.activation, i, count, a);
  Floats Y0[1];
  load_columns(g.basis + g.bases * i, count, Y0, g.bases);
  activation_vjp(g.lr, a, Y0[0], i, count, b.lr);
  if (g.hr) activation_vjp(g.hr, a, Y0[0], i, count, b.hr);
  if (g.detail) load_columns(g.detail + 3 * i, count, b.detail);
}

// Prefetches what `load` reads.
CLEAR_INLINE void fetch(const Gradients& g, std::int64_t i) {
  const Activation& a = g.activation;
  fetch_rows(a.scales, i, 3), fetch_rows(a.filtered, i, 3), fetch_rows(a.filter, i, 1), fetch_rows(a.sigmoid, i, 1);
  fetch_rows(a.factor, i, 1), fetch_rows(g.detail, i, 3);
  for (const SplatGradient* loss : {&g.lr, &g.hr}) {
    fetch_rows(loss->means, i, 3), fetch_rows(loss->quats, i, 4), fetch_rows(loss->scales, i, 3);
    fetch_rows(loss->opacities, i, 1), fetch_rows(loss->rgb, i, 3);
  }
  fetch_rows(g.basis, i, g.bases);
}

}  // namespace clear
