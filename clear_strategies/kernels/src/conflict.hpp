// Where do LR and HR gradients disagree, and what becomes of the HR one? Decisions in double: no product of two floats
// over- or underflows there.  Eq. 6, 7, 11
#pragma once

#include <algorithm>
#include <limits>

#include "pulled.hpp"

namespace clear {

// The paper's six groups in the order of gradients.CONFLICT_GROUPS; as a seventh, the Gaussian as a whole.
enum Group { kMeans, kSh0, kShN, kOpacities, kScales, kQuats, kGroups, kGaussian = kGroups };

struct Products {
  Doubles dot = 0.0, l2 = 0.0, h2 = 0.0;  // ⟨l, h⟩, ‖l‖², ‖h‖²

  CLEAR_INLINE Products& operator+=(const Products& o) {
    dot += o.dot, l2 += o.l2, h2 += o.h2;
    return *this;
  }
};

template <int D>
CLEAR_INLINE Products products(const Floats (&l)[D], const Floats (&h)[D]) {
  Products p;
  for (int d = 0; d < D; ++d) {
    Doubles a = widen(l[d]), b = widen(h[d]);
    p.dot += a * b, p.l2 += a * a, p.h2 += b * b;
  }
  return p;
}

CLEAR_INLINE void group_products(const Gradients& g, const Block& b, std::int64_t i, int count, Products* p) {
  p[kMeans] = products(b.lr.means, b.hr.means);
  p[kSh0] = products(b.lr.sh0, b.hr.sh0);
  p[kOpacities] = products(b.lr.opacities, b.hr.opacities);
  p[kScales] = products(b.lr.scales, b.hr.scales);
  p[kQuats] = products(b.lr.quats, b.hr.quats);
  BasisProducts Y = basis_products(g.lr.basis, g.base.basis, g.bases, i, count);
  Products rgb = products(b.lr.rgb, b.hr.rgb);
  p[kShN] = {Y.cross * rgb.dot, Y.lr2 * rgb.l2, Y.hr2 * rgb.h2};
}

// Counts of one stretch of Gaussians, before correction; sums run in the order of the stretches.
struct Comparison {
  std::int64_t comparable[kGroups + 1] = {}, opposed[kGroups + 1] = {};
  double norm_lr[kGroups] = {}, norm_hr[kGroups] = {};  // Σ ‖l‖, Σ ‖h‖ over comparable Gaussians

  void add(const Comparison& o) {
    for (int k = 0; k <= kGroups; ++k) comparable[k] += o.comparable[k], opposed[k] += o.opposed[k];
    for (int k = 0; k < kGroups; ++k) norm_lr[k] += o.norm_lr[k], norm_hr[k] += o.norm_hr[k];
  }
};

// GCO's settings, with ε as numbers.
struct Correction {
  bool corrects[kGroups] = {};
  double eps_cos[kGroups] = {}, eps_corr[kGroups] = {};
  double tolerance, weight_min, weight_max;
  double rotation_noise;           // ‖g_quats‖ at or below this times ‖g_scales‖ is rounding
  bool bounds_hold_omega;          // else they hold the coefficient
  const float* reliability;        // q_i, or null for 0
};

struct Corrected {
  std::int64_t rows[kGroups] = {}, at_lower_bound[kGroups] = {};
  double omega[kGroups] = {};  // Σ ω

  void add(const Corrected& o) {
    for (int k = 0; k < kGroups; ++k) {
      rows[k] += o.rows[k], at_lower_bound[k] += o.at_lower_bound[k];
      omega[k] += o.omega[k];
    }
  }
};

// Which of the sixteen are corrected in this group, and by which multiple of g_LR.
CLEAR_INLINE std::uint32_t correction_steps(const Correction& c, Group group, const Products& p, std::uint32_t candidates,
                                            std::int64_t i, double (&step)[kLanes], Corrected& done) {
  Doubles n_lr = root(p.l2), n_hr = root(p.h2), n = n_lr * n_hr, zero = 0.0;
  Doubles n_eps = maximum(n + Doubles(c.eps_cos[group]), Doubles(std::numeric_limits<double>::min()));
  Doubles cosine = p.dot / n_eps;  // Eq. 6
  std::uint32_t conflict = ((n > zero) & (cosine < Doubles(-c.tolerance))).bits() & candidates;
  if (!conflict) return 0;
  double C[kLanes], N[kLanes], L[kLanes], dot[kLanes];
  cosine.store(C), n.store(N), n_lr.store(L), p.dot.store(dot);
  for (std::uint32_t rest = conflict; rest; rest &= rest - 1) {
    int k = __builtin_ctz(rest);
    double q = c.reliability ? double(c.reliability[i + k]) : 0.0;
    double s = std::clamp((-C[k] - c.tolerance) / (1 - c.tolerance), 0.0, 1.0);
    double omega = s * (1 - q);  // Eq. 11
    double coefficient = (dot[k] + c.tolerance * N[k]) / (L[k] * L[k] + c.eps_corr[group]);
    if (c.bounds_hold_omega) {
      omega = std::clamp(omega, c.weight_min, c.weight_max);
      step[k] = omega * coefficient;
    } else {
      step[k] = -std::clamp(std::abs(omega * coefficient), c.weight_min, c.weight_max);
    }
    done.rows[group] += 1;
    done.omega[group] += omega;
    done.at_lower_bound[group] += omega <= c.weight_min;
  }
  return conflict;
}

CLEAR_INLINE float corrected(float h, float l, double step) { return float(double(h) - double(l) * step); }  // Eq. 7

template <int D>
CLEAR_INLINE void correct_columns(Floats (&h)[D], const Floats (&l)[D], std::uint32_t rows, const double (&step)[kLanes]) {
  if (!rows) return;
  for (int d = 0; d < D; ++d) {
    float a[kLanes], b[kLanes];
    l[d].store(a), h[d].store(b);
    for (std::uint32_t rest = rows; rest; rest &= rest - 1) {
      int k = __builtin_ctz(rest);
      b[k] = corrected(b[k], a[k], step[k]);
    }
    h[d] = Floats::load(b);
  }
}

}  // namespace clear
