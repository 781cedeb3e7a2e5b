// Compiled with -ffp-contract=off, as step.cpp is, so that both make the decisions of the readable path.
#include "merge.hpp"

#include "chunks.hpp"
#include "pool.hpp"

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

// Sixteen rows of Y ⊗ ∇rgb, from the same rows of its factors: band `first_band` + j / 3 and channel j % 3 for number j.
CLEAR_INLINE void expand(const float* rgb_rows, const float* basis, int bases, const MergedRows& a, const RowPlan& plan, int count,
                         float* to) {
  if (count < kLanes) std::fill_n(to, kLanes * a.width, 0.0f);
  if (a.first_band == 0) {
    Floats rgb[3], Y0[1];
    load_columns(rgb_rows, count, rgb), load_columns(basis, count, Y0, bases);
    for (Floats& channel : rgb) channel *= Y0[0];
    join_rows(to, rgb);
    return;
  }
  float colour[4 * kLanes] = {};  // padded, because reads are sixteen wide
  std::copy_n(rgb_rows, 3 * count, colour);
  for (int k = 0; k < count; ++k, to += a.width) {
    Floats Y = load_some(basis + bases * k, bases), rgb = Floats::load(colour + 3 * k);
    float few[kLanes];  // of a row of less than sixteen numbers
    float* row = a.width < kLanes ? few : to;
    for (int v = 0; v < plan.sixteens; ++v) (pick(Y, plan.band[v]) * pick(rgb, plan.channel[v])).store(row + plan.offset[v]);
    if (a.width < kLanes) std::copy_n(few, a.width, to);
  }
}

template <int D>
CLEAR_INLINE Products products_of_columns(const float* l, const float* h) {
  Floats a[D], b[D];
  load_columns(l, kLanes, a), load_columns(h, kLanes, b);
  return products(a, b);
}

// The same row by row, for rows that are longer than a few numbers.
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

CLEAR_INLINE Products products_of(const float* l, const float* h, int width) {
  return width == 1   ? products_of_columns<1>(l, h)
         : width == 3 ? products_of_columns<3>(l, h)
         : width == 4 ? products_of_columns<4>(l, h)
                      : products_of_rows(l, h, width);
}

class ChunkMerge {
 public:
  ChunkMerge(const Merge& m, const Correction* correction) : m(m), correction(correction) {
    for (const MergedRows& a : m.attributes) plans.emplace_back(a.width);
    one_basis = m.keeps_lr && m.lambda_hr > 0 && m.lr.rgb && m.hr.rgb && m.lr.basis == m.hr.basis && m.lr.bases == m.hr.bases;
  }

  Merged run(std::int64_t number) const {
    Merged done;
    Tally tally;
    each_sixteen(m.n, number, [&](std::int64_t i, int count) { sixteen(i, count, done.finite, tally); });
    done.conflicts = tally.total();
    return done;
  }

 private:
  const Merge& m;
  const Correction* correction;
  std::vector<RowPlan> plans;
  bool one_basis;  // of both gradients of the colours

  struct Gradients {
    const float *l, *h;
    alignas(64) float l_copy[kBlock], h_copy[kBlock];
  };

  void sixteen(std::int64_t i, int count, bool& finite, Tally& tally) const {
    Gradients rows[kGroups + 1];
    Products p[kGroups];
    for (std::size_t k = 0; k < m.attributes.size(); ++k) {
      const MergedRows& a = m.attributes[k];
      if (in_factors(a)) {
        p[kShN] = products_of_factors(i, count);
        continue;
      }
      read(a, plans[k], i, count, rows[k]);
      if (a.group < kGroups && m.lambda_hr > 0) p[a.group] = products_of(rows[k].l, rows[k].h, a.width);
    }
    Multiples multiples;
    if (m.lambda_hr > 0) multiples = decide(p, correction, i, count, tally);
    for (std::size_t k = 0; k < m.attributes.size(); ++k) {
      const MergedRows& a = m.attributes[k];
      if (in_factors(a)) {
        merge_factors(a, plans[k], multiples, i, count, rows[k]);
        write(a, rows[k], 0, i, count, finite);
        continue;
      }
      if (a.group < kGroups && multiples.any[a.group]) correct_rows(rows[k], a.width, multiples.of[a.group]);
      write(a, rows[k], m.lambda_hr, i, count, finite);
    }
  }

  // Whether both gradients are Y ⊗ ∇rgb with one Y, so that they are compared, corrected and added as ∇rgb.
  bool in_factors(const MergedRows& a) const { return one_basis && a.group == kShN && !a.lr && !a.before && !a.hr; }

  CLEAR_INLINE void load_factors(std::int64_t i, int count, Floats (&l)[3], Floats (&h)[3]) const {
    load_columns(m.lr.rgb + 3 * i, count, l), load_columns(m.hr.rgb + 3 * i, count, h);
    if (m.scale != 1)
      for (Floats& channel : l) channel *= 1 / m.scale;
  }

  CLEAR_INLINE Products products_of_factors(std::int64_t i, int count) const {
    Floats l[3], h[3];
    load_factors(i, count, l, h);
    Products rgb = products(l, h);
    Doubles Y2 = basis_products(m.lr.basis, m.lr.basis, m.lr.bases, i, count).lr2;
    return {Y2 * rgb.dot, Y2 * rgb.l2, Y2 * rgb.h2};
  }

  // The merged rows, as those of LR.
  CLEAR_INLINE void merge_factors(const MergedRows& a, const RowPlan& plan, const Multiples& multiples, std::int64_t i, int count,
                                  Gradients& g) const {
    Floats l[3], h[3];
    load_factors(i, count, l, h);
    correct(multiples, kShN, h, l);  // Eq. 7
    for (int c = 0; c < 3; ++c) l[c] += h[c] * Floats(m.lambda_hr);  // Eq. 8
    alignas(64) float rgb[3 * kLanes];
    join_rows(rgb, l);
    expand(rgb, m.lr.basis + m.lr.bases * i, m.lr.bases, a, plan, count, g.l_copy);
    g.l = g.h = g.l_copy;
  }

  void read(const MergedRows& a, const RowPlan& plan, std::int64_t i, int count, Gradients& g) const {
    const bool from_colour = a.first_band >= 0 && m.lr.rgb;
    float product[kBlock];
    if (from_colour) expand(m.lr.rgb + 3 * i, m.lr.basis + m.lr.bases * i, m.lr.bases, a, plan, count, a.lr ? product : g.l_copy);
    g.l = from_colour && !a.lr ? g.l_copy : block_of(a.lr, i, count, a.width, g.l_copy);
    if (a.lr && (from_colour || a.before)) {
      float zeros[kBlock];
      const float* before = block_of(a.before, i, count, a.width, zeros);
      for (int j = 0; j < kLanes * a.width; j += kLanes) {
        Floats own = Floats::load(g.l + j) - Floats::load(before + j);
        (from_colour ? own + Floats::load(product + j) : own).store(g.l_copy + j);
      }
      g.l = g.l_copy;
    }
    if (m.scale != 1 && (a.lr || from_colour)) {
      for (int j = 0; j < kLanes * a.width; j += kLanes) (Floats::load(g.l + j) * Floats(1 / m.scale)).store(g.l_copy + j);
      g.l = g.l_copy;
    }
    if (m.keeps_lr && m.lambda_hr == 0) {
      g.h = g.l;  // not added
    } else if (!a.hr && a.first_band >= 0 && m.hr.rgb) {
      expand(m.hr.rgb + 3 * i, m.hr.basis + m.hr.bases * i, m.hr.bases, a, plan, count, g.h_copy);
      g.h = g.h_copy;
    } else {
      g.h = block_of(a.hr, i, count, a.width, g.h_copy);
    }
  }

  static void correct_rows(Gradients& g, int width, const Doubles& multiples) {
    double multiple[kLanes];
    multiples.store(multiple);
    if (g.h != g.h_copy) std::copy_n(g.h, kLanes * width, g.h_copy), g.h = g.h_copy;
    for (int k = 0; k < kLanes; ++k) {
      if (multiple[k] == 0) continue;
      float* h = g.h_copy + k * width;
      const float* l = g.l + k * width;
      for (int j = 0; j < width; ++j) h[j] = float(double(h[j]) - double(l[j]) * multiple[k]);  // Eq. 7
    }
  }

  void write(const MergedRows& a, const Gradients& g, float lambda_hr, std::int64_t i, int count, bool& finite) const {
    Floats λ = lambda_hr, scale = m.scale, stiffness = a.stiffness, most = std::numeric_limits<float>::max();
    float last[kLanes];
    std::int64_t from = i * a.width;
    int numbers = count * a.width;
    for (int j = 0; j < numbers; j += kLanes) {
      int few = std::min(kLanes, numbers - j);
      Floats total = Floats::load(g.h + j);
      if (m.keeps_lr) {
        total = lambda_hr > 0 ? Floats::load(g.l + j) + total * λ : Floats::load(g.l + j);  // Eq. 8
        if (a.anchor) total += (load_some(a.p + from + j, few) - load_some(a.anchor + from + j, few)) * stiffness;  // Eq. 16
        if (m.scale != 1) total = total * scale;
        if (a.before) total += load_some(a.before + from + j, few);
      }
      finite &= ((absolute(total) <= most).bits() & first_bits(few)) == first_bits(few);
      if (few == kLanes) {
        total.store(a.out + from + j);
      } else {
        total.store(last);
        std::copy_n(last, few, a.out + from + j);
      }
    }
  }
};

}  // namespace

Merged merge(const Merge& m, const Correction* correction, int threads) {
  std::vector<Merged> parts(chunks(m.n));
  ChunkMerge chunk(m, correction);
  Pool::instance().run(threads, std::int64_t(parts.size()), [&](std::int64_t k) { parts[k] = chunk.run(k); });
  Merged total;
  for (const Merged& part : parts) total.conflicts.add(part.conflicts), total.finite &= part.finite;
  return total;
}

}  // namespace clear
