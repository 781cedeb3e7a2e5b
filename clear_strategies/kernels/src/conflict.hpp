// The conflict between LR and HR gradients by group, and the correction of the HR gradient (Eq. 6, 7, 11). Decisions are
// made in double, where no product of two floats over- or underflows.
#pragma once

#include <algorithm>
#include <limits>

#include "raw_gradients.hpp"

namespace clear {

// The paper's six groups in the order of core.gradients.CONFLICT_GROUPS, and the whole Gaussian as a seventh.
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

// What a chunk of Gaussians shows, by group: comparable and opposed ones before correction, corrected ones, Σ ω over these, and
// those with ω at its lower bound. Chunks are added up in order.
struct Conflicts {
  std::int64_t comparable[kGroups + 1] = {}, opposed[kGroups + 1] = {}, corrected[kGroups] = {}, at_lower_bound[kGroups] = {};
  double omega[kGroups] = {};

  void add(const Conflicts& o) {
    for (int k = 0; k <= kGroups; ++k) comparable[k] += o.comparable[k], opposed[k] += o.opposed[k];
    for (int k = 0; k < kGroups; ++k)
      corrected[k] += o.corrected[k], at_lower_bound[k] += o.at_lower_bound[k], omega[k] += o.omega[k];
  }
};

// The settings of GCO, and the reliability of each Gaussian.
struct Correction {
  bool corrects[kGroups] = {};
  double tolerance, weight_min, weight_max;
  double rotation_noise;           // a ‖g_quats‖ up to this times ‖g_scales‖ counts as rounding
  const float* reliability;        // q_i, or null for 0
};

// A chunk's counts, with Σ ω by lane.
struct Tally : Conflicts {
  Doubles omegas[kGroups];

  Tally() {
    for (Doubles& o : omegas) o = 0.0;
  }
  Conflicts total() const {
    Conflicts c = *this;
    for (int k = 0; k < kGroups; ++k) c.omega[k] = sum(omegas[k]);
    return c;
  }
};

// The multiple of g_LR that is subtracted from each HR gradient of the group; 0 where there is no conflict. Returns false
// if there is none at all.
CLEAR_INLINE bool correction_multiples(const Correction& c, Group group, const Products& p, const Mask<double>& candidates,
                                   const Doubles& q, Doubles& multiple, Tally& done) {
  Doubles zero = 0.0, one = 1.0, tau = c.tolerance;
  auto apart = (p.dot < zero) & candidates;
  if (!apart.any()) return false;
  Doubles n = root(p.l2 * p.h2);  // ‖l‖‖h‖; a product of four floats fits a double
  Doubles low = c.weight_min, high = c.weight_max;
  Doubles cosine = p.dot / maximum(n, Doubles(std::numeric_limits<double>::min()));  // Eq. 6
  auto conflict = (n > zero) & (cosine < -tau) & apart;
  if (!conflict.any()) return false;
  Doubles s = clamp((-cosine - tau) / (one - tau), zero, one);
  Doubles omega = clamp(s * (one - q), low, high);  // Eq. 11
  multiple = where(conflict, omega * ((p.dot + tau * n) / p.l2));
  done.omegas[group] += where(conflict, omega);
  done.corrected[group] += __builtin_popcount(conflict.bits());
  done.at_lower_bound[group] += __builtin_popcount((conflict & (omega <= low)).bits());
  return true;
}

// A Gaussian with equal axes does not change under rotation, so its rotation gradient is noise.
CLEAR_INLINE Mask<double> turns_something(const Products (&p)[kGroups], double rotation_noise) {
  Doubles noise2 = rotation_noise * rotation_noise;
  return (p[kQuats].l2 > noise2 * p[kScales].l2) & (p[kQuats].h2 > noise2 * p[kScales].h2);
}

// By group, the multiple of g_LR that is subtracted from g_HR, and whether it is other than 0 for any of sixteen Gaussians.
struct Multiples {
  Doubles of[kGroups];
  bool any[kGroups] = {};
};

// Counts the conflicts of sixteen Gaussians, and decides on their correction; null: none. Lanes beyond the last Gaussian are
// zeros, which do not conflict.
CLEAR_INLINE Multiples decide(const Products (&p)[kGroups], const Correction* c, std::int64_t i, int count, Tally& tally) {
  Multiples out;
  Products whole;
  Doubles zero = 0.0;
  for (int k = 0; k <= kGroups; ++k) {
    const Products& x = k < kGroups ? p[k] : whole;
    if (k < kGroups) whole += x;
    auto comparable = (x.l2 > zero) & (x.h2 > zero);
    tally.comparable[k] += __builtin_popcount(comparable.bits());
    tally.opposed[k] += __builtin_popcount((comparable & (x.dot < zero)).bits());
  }
  if (!c) return out;
  Doubles q = c->reliability ? widen(load_some(c->reliability + i, count)) : Doubles(0.0);
  for (int k = 0; k < kGroups; ++k)
    if (c->corrects[k]) {
      auto candidates = k == kQuats ? turns_something(p, c->rotation_noise) : zero <= zero;
      out.any[k] = correction_multiples(*c, Group(k), p[k], candidates, q, out.of[k], tally);
    }
  return out;
}

// h - multiple · l; rows with multiple 0 keep their bits.
CLEAR_INLINE Floats corrected(const Floats& h, const Floats& l, const Doubles& multiple) {
  auto touched = narrow(where(absolute(multiple) > Doubles(0.0), Doubles(1.0))) > Floats(0.0f);
  return select(touched, narrow(widen(h) - widen(l) * multiple), h);  // Eq. 7
}

template <int D>
CLEAR_INLINE void correct(const Multiples& m, Group group, Floats (&h)[D], const Floats (&l)[D]) {
  if (m.any[group])
    for (int d = 0; d < D; ++d) h[d] = corrected(h[d], l[d], m.of[group]);
}

}  // namespace clear
