// What a reconciliation of two gradients needs of the numbers of a Gaussian: inner products by group before its weights are known,
// and the gradient that the weights leave. Both in double, where no product of two floats over- or underflows.
#pragma once

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

// How many Gaussians can be compared, since neither gradient is 0, and how many of them oppose each other, by group. Chunks are
// added up in order.
struct Conflicts {
  std::int64_t comparable[kGroups + 1] = {}, opposed[kGroups + 1] = {};

  void add(const Conflicts& o) {
    for (int k = 0; k <= kGroups; ++k) comparable[k] += o.comparable[k], opposed[k] += o.opposed[k];
  }
  CLEAR_INLINE void count(int group, const Products& p) {
    Doubles zero = 0.0;
    auto both = (p.l2 > zero) & (p.h2 > zero);
    comparable[group] += __builtin_popcount(both.bits());
    opposed[group] += __builtin_popcount((both & (p.dot < zero)).bits());
  }
};

// The products of n Gaussians, [3, kGroups, n].
struct ProductTable {
  double* rows;
  std::int64_t n;

  // Writes those of the Gaussians from i on, and counts their conflicts. Lanes beyond the last are zeros, which do not conflict.
  CLEAR_INLINE void write(const Products (&p)[kGroups], std::int64_t i, int count, Conflicts& found) const {
    Products whole;
    for (int k = 0; k < kGroups; ++k) {
      double* to = rows + k * n + i;
      for (const Doubles* x : {&p[k].dot, &p[k].l2, &p[k].h2}) {
        store_some(to, *x, count);
        to += kGroups * n;
      }
      found.count(k, p[k]);
      whole += p[k];
    }
    found.count(kGaussian, whole);
  }
};

// A weight of each Gaussian and group.
struct Weight {
  double number = 0;           // of all, where there are no rows
  const double* rows = nullptr;
  std::int64_t stride = 0;     // from one group to the next; 0: the groups share one weight

  CLEAR_INLINE Doubles of(int group, std::int64_t i, int count) const {
    return rows ? load_some(rows + group * stride + i, count) : Doubles(number);
  }
  bool is(double other) const { return !rows && number == other; }
};

// ĝ = keep · g_HR - remove · g_LR, which has the bits of g_HR where keep is 1 and remove is 0.
struct Weights {
  Weight keep{1}, remove{0};

  bool changes_nothing() const { return keep.is(1) && remove.is(0); }
};

CLEAR_INLINE Floats reconciled(const Floats& h, const Floats& l, const Doubles& keep, const Doubles& remove) {
  return narrow(widen(h) * keep - widen(l) * remove);
}

template <int D>
CLEAR_INLINE void reconcile(const Weights& w, Group group, Floats (&h)[D], const Floats (&l)[D], std::int64_t i, int count) {
  if (w.changes_nothing()) return;
  Doubles keep = w.keep.of(group, i, count), remove = w.remove.of(group, i, count);
  for (int d = 0; d < D; ++d) h[d] = reconciled(h[d], l[d], keep, remove);
}

}  // namespace clear
