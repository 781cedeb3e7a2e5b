// Compiled with -ffp-contract=off, as step.cpp is, so that both give the same products.
#include "reconcile.hpp"

#include "pool.hpp"
#include "sh_rows.hpp"

namespace clear {
namespace {

constexpr int kBlock = kLanes * kWidest;

// The numbers of sixteen Gaussians from `rows`, where these are whole; else a copy of them, with zeros after the last.
CLEAR_INLINE const float* block_of(const float* rows, std::int64_t i, int count, int width, float* copy) {
  if (rows && count == kLanes) return rows + i * width;
  std::fill_n(copy, kLanes * width, 0.0f);
  if (rows) std::copy_n(rows + i * width, count * width, copy);
  return copy;
}

CLEAR_INLINE Products products_of_rows(const float* l, const float* h, int width) {
  double dot[kLanes], l2[kLanes], h2[kLanes];
  for (int k = 0; k < kLanes; ++k, l += width, h += width) {
    Products p;
    int j = 0;
    auto add = [&](const Floats& low, const Floats& high) CLEAR_LAMBDA {
      Doubles a = widen(low), b = widen(high);
      p.dot += a * b, p.l2 += a * a, p.h2 += b * b;
    };
    for (; j + kLanes <= width; j += kLanes) add(Floats::load(l + j), Floats::load(h + j));
    if (int rest = width - j; rest && width >= kLanes) {  // the last sixteen, without those that were added
      auto fresh = Mask<float>::from_bits(0xffffu & (0xffffu << (kLanes - rest)));
      add(where(fresh, Floats::load(l + width - kLanes)), where(fresh, Floats::load(h + width - kLanes)));
    } else if (rest) {
      add(load_some(l, width), load_some(h, width));
    }
    dot[k] = sum(p.dot), l2[k] = sum(p.l2), h2[k] = sum(p.h2);
  }
  return {Doubles::load(dot), Doubles::load(l2), Doubles::load(h2)};
}

// Sixteen Gaussians of one attribute.
struct Sixteen {
  const float *l, *h;
  alignas(64) float l_copy[kBlock], h_copy[kBlock];
};

class Passes {
 public:
  explicit Passes(const TwoGradients& g) : g(g) {
    for (const Rows& a : g.attributes) plans.emplace_back(a.width);
    one_basis = g.lr.rgb && g.hr.rgb && g.lr.basis == g.hr.basis && g.lr.bases == g.hr.bases;
  }

  Conflicts products(std::int64_t number, const ProductTable& to) const {
    Conflicts found;
    each_sixteen(g.n, number, [&](std::int64_t i, int count) {
      fetch(i + kLanes);
      clear::Products p[kGroups];
      for (std::size_t k = 0; k < g.attributes.size(); ++k) {
        const Rows& a = g.attributes[k];
        if (a.group < kGroups && has(a, a.lr, g.lr) && has(a, a.hr, g.hr)) p[a.group] = products_of(a, plans[k], i, count);
      }
      to.write(p, i, count, found);
    });
    return found;
  }

  bool apply(std::int64_t number, const Weights& w, float lambda_hr, bool keeps_lr) const {
    bool finite = true;
    each_sixteen(g.n, number, [&](std::int64_t i, int count) {
      for (std::size_t k = 0; k < g.attributes.size(); ++k) {
        const Rows& a = g.attributes[k];
        bool corrects = has(a, a.hr, g.hr) || (a.group < kGroups && !w.remove.is(0));
        merge(a, plans[k], w, !keeps_lr ? 1 : corrects ? lambda_hr : 0, keeps_lr, i, count, finite);
      }
    });
    return finite;
  }

 private:
  const TwoGradients& g;
  std::vector<RowPlan> plans;
  bool one_basis;  // of both gradients of the colours

  // Prefetches what `products` reads of sixteen Gaussians.
  CLEAR_INLINE void fetch(std::int64_t i) const {
    for (const Rows& a : g.attributes) fetch_rows(a.lr, i, a.width), fetch_rows(a.hr, i, a.width);
    for (const Colour* c : {&g.lr, &g.hr}) fetch_rows(c->rgb, i, 3), fetch_rows(c->rgb ? c->basis : nullptr, i, c->bases);
  }

  static bool has(const Rows& a, const float* rows, const Colour& colour) { return rows || (a.first_band >= 0 && colour.rgb); }

  // Whether both gradients are Y ⊗ ∇rgb with one Y, so that they are compared, reconciled and added as ∇rgb.
  bool in_factors(const Rows& a) const { return one_basis && a.first_band == 1 && !a.lr && !a.hr; }

  CLEAR_INLINE void load_factors(std::int64_t i, int count, Floats (&l)[3], Floats (&h)[3]) const {
    load_columns(g.lr.rgb + 3 * i, count, l), load_columns(g.hr.rgb + 3 * i, count, h);
  }

  // A row of a few numbers, one Gaussian per lane.
  template <int D>
  static CLEAR_INLINE void load(const Rows& a, const float* rows, const Colour& colour, std::int64_t i, int count, Floats (&x)[D]) {
    for (Floats& column : x) column = 0.0f;
    if (rows) load_columns(rows + D * i, count, x);
    if constexpr (D == 3)
      if (a.first_band == 0 && colour.rgb) {
        Floats rgb[3], Y0[1];
        load_columns(colour.rgb + 3 * i, count, rgb), load_columns(colour.basis + colour.bases * i, count, Y0, colour.bases);
        for (int d = 0; d < 3; ++d) x[d] += Y0[0] * rgb[d];
      }
  }

  // Sixteen longer rows: where they lie, or a copy of them.
  static const float* read(const Rows& a, const RowPlan& plan, const float* rows, const Colour& colour, std::int64_t i, int count, float* copy) {
    if (a.first_band != 1 || !colour.rgb) return block_of(rows, i, count, a.width, copy);
    expand(colour.rgb + 3 * i, colour.basis + colour.bases * i, colour.bases, plan, count, copy);
    if (rows)
      for (int j = 0; j < count * a.width; ++j) copy[j] += rows[i * a.width + j];
    return copy;
  }

  CLEAR_INLINE clear::Products products_of(const Rows& a, const RowPlan& plan, std::int64_t i, int count) const {
    if (a.first_band != 1 && a.width == 1) return products_of_columns<1>(a, i, count);
    if (a.first_band != 1 && a.width == 3) return products_of_columns<3>(a, i, count);
    if (a.first_band != 1 && a.width == 4) return products_of_columns<4>(a, i, count);
    if (in_factors(a)) {
      Floats l[3], h[3];
      load_factors(i, count, l, h);
      clear::Products rgb = clear::products(l, h);
      Doubles Y2 = higher_bands2(g.lr.basis, g.lr.bases, i, count);
      return {Y2 * rgb.dot, Y2 * rgb.l2, Y2 * rgb.h2};
    }
    Sixteen b;
    return products_of_rows(read(a, plan, a.lr, g.lr, i, count, b.l_copy), read(a, plan, a.hr, g.hr, i, count, b.h_copy), a.width);
  }

  template <int D>
  CLEAR_INLINE clear::Products products_of_columns(const Rows& a, std::int64_t i, int count) const {
    Floats l[D], h[D];
    load(a, a.lr, g.lr, i, count, l), load(a, a.hr, g.hr, i, count, h);
    return clear::products(l, h);
  }

  CLEAR_INLINE void merge(const Rows& a, const RowPlan& plan, const Weights& w, float λ, bool keeps_lr, std::int64_t i, int count,
                          bool& finite) const {
    if (a.first_band != 1 && a.width == 1) return merge_columns<1>(a, w, λ, keeps_lr, i, count, finite);
    if (a.first_band != 1 && a.width == 3) return merge_columns<3>(a, w, λ, keeps_lr, i, count, finite);
    if (a.first_band != 1 && a.width == 4) return merge_columns<4>(a, w, λ, keeps_lr, i, count, finite);
    alignas(64) float merged[kBlock];
    if (keeps_lr && λ > 0 && in_factors(a)) {
      Floats l[3], h[3];
      load_factors(i, count, l, h);
      reconcile(w, kShN, h, l, i, count);
      for (int c = 0; c < 3; ++c) l[c] += h[c] * Floats(λ);
      alignas(64) float rgb[3 * kLanes];
      join_rows(rgb, l);
      expand(rgb, g.lr.basis + g.lr.bases * i, g.lr.bases, plan, count, merged);
      return write(a, merged, i, count, finite);
    }
    Sixteen b;
    b.l = read(a, plan, a.lr, g.lr, i, count, b.l_copy);
    if (λ == 0) return write(a, b.l, i, count, finite);
    b.h = read(a, plan, a.hr, g.hr, i, count, b.h_copy);
    if (a.group < kGroups) reconcile_rows(w, Group(a.group), a.width, i, count, b);
    if (!keeps_lr) return write(a, b.h, i, count, finite);
    for (int j = 0; j < kLanes * a.width; j += kLanes) (Floats::load(b.l + j) + Floats::load(b.h + j) * Floats(λ)).store(merged + j);
    write(a, merged, i, count, finite);
  }

  template <int D>
  CLEAR_INLINE void merge_columns(const Rows& a, const Weights& w, float λ, bool keeps_lr, std::int64_t i, int count, bool& finite) const {
    Floats l[D], h[D];
    load(a, a.lr, g.lr, i, count, l);
    if (λ > 0) {
      load(a, a.hr, g.hr, i, count, h);
      if (a.group < kGroups) reconcile(w, Group(a.group), h, l, i, count);
      for (int d = 0; d < D; ++d) l[d] = keeps_lr ? l[d] + h[d] * Floats(λ) : h[d];
    }
    alignas(64) float merged[D * kLanes];
    join_rows(merged, l);
    write(a, merged, i, count, finite);
  }

  static void reconcile_rows(const Weights& w, Group group, int width, std::int64_t i, int count, Sixteen& b) {
    if (w.changes_nothing()) return;
    double keep[kLanes], remove[kLanes];
    w.keep.of(group, i, count).store(keep), w.remove.of(group, i, count).store(remove);
    if (b.h != b.h_copy) std::copy_n(b.h, kLanes * width, b.h_copy), b.h = b.h_copy;
    for (int k = 0; k < count; ++k) {
      if (keep[k] == 1 && remove[k] == 0) continue;
      float* h = b.h_copy + k * width;
      const float* l = b.l + k * width;
      for (int j = 0; j < width; ++j) h[j] = float(double(h[j]) * keep[k] - double(l[j]) * remove[k]);
    }
  }

  // Adds what regularizers give, and writes the rows of the Gaussians that are there.
  static CLEAR_INLINE void write(const Rows& a, const float* merged, std::int64_t i, int count, bool& finite) {
    Floats most = std::numeric_limits<float>::max();
    std::int64_t from = i * a.width;
    int numbers = count * a.width;
    for (int j = 0; j < numbers; j += kLanes) {
      int few = std::min(kLanes, numbers - j);
      Floats total = Floats::load(merged + j);
      if (a.plus) total += load_some(a.plus + from + j, few);
      finite &= ((absolute(total) <= most).bits() & first_bits(few)) == first_bits(few);
      store_some(a.out + from + j, total, few);
    }
  }
};

}  // namespace

Conflicts products(const TwoGradients& g, ProductTable to, int threads) {
  std::vector<Conflicts> parts(chunks(g.n));
  Passes passes(g);
  Pool::instance().run(threads, std::int64_t(parts.size()), [&](std::int64_t k) { parts[k] = passes.products(k, to); });
  Conflicts total;
  for (const Conflicts& part : parts) total.add(part);
  return total;
}

bool apply(const TwoGradients& g, const Weights& w, float lambda_hr, bool keeps_lr, int threads) {
  std::vector<char> finite(chunks(g.n));
  Passes passes(g);
  Pool::instance().run(threads, std::int64_t(finite.size()), [&](std::int64_t k) { finite[k] = passes.apply(k, w, lambda_hr, keeps_lr); });
  return std::all_of(finite.begin(), finite.end(), [](char part) { return part != 0; });
}

}  // namespace clear
