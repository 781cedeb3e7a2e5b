// Compiled with -ffp-contract=off: products and sums round as in torch, and multiply-adds are used only where torch uses
// them, so that the step makes the same decisions as the readable path.
#include "step.hpp"

#include <vector>

#include "chunks.hpp"
#include "pool.hpp"

namespace clear {
namespace {

struct RowTables {
  Floats Y_lr, Y_hr, lr, base, hf;
};

// Sixteen numbers of g = g_LR + λ ĝ_HR in an shN row, from its factors.
CLEAR_INLINE Floats expand(const Gradients& g, const Step& s, const RowTables& t, float m, double correction,
                           const std::int32_t* band, const std::int32_t* channel) {
  Floats l = pick(t.Y_lr, band) * pick(t.lr, channel);
  if (!g.base) return l;
  Floats Y = g.lr.basis == g.base.basis ? pick(t.Y_lr, band) : pick(t.Y_hr, band);
  Floats h = Y * pick(t.base, channel);
  if (g.hf) h += Y * pick(t.hf, channel) * Floats(m) * Floats(g.lambda_hf);  // Eq. 13
  if (correction != 0) h = corrected(h, l, correction);
  return l + h * Floats(s.lambda_hr);  // Eq. 8
}

CLEAR_INLINE Floats basis_row(const SplatGradient& g, int bases, std::int64_t row) {
  return load_some(g.basis + bases * row, bases);
}

class ChunkStep {
 public:
  ChunkStep(const Gradients& g, const Correction* correction, const Step& s)
      : g(g), correction(correction), s(s), plan(s.width) {}

  Stepped run(std::int64_t number) const {
    Stepped done;
    Tally tally;
    each_sixteen(g.n, number, [&](std::int64_t i, int count) { sixteen(i, count, done, tally); });
    done.conflicts = tally.total();
    return done;
  }

 private:
  const Gradients& g;
  const Correction* correction;
  const Step& s;
  const RowPlan plan;

  void sixteen(std::int64_t i, int count, Stepped& done, Tally& tally) const {
    fetch(g, i + kLanes);
    Block b;
    load(g, i, count, b);
    std::uint32_t rows = first_bits(count);
    std::uint32_t still = s.skips ? still_rows(b, i, rows) : 0;
    done.still += __builtin_popcount(still);
    std::uint32_t moving = rows & ~still;

    double shN_multiple[kLanes] = {};
    if (g.base && s.lambda_hr > 0) {
      Products p[kGroups];
      group_products(g, b, i, count, p);
      Multiples m = decide(p, correction, i, count, tally);
      correct(m, kMeans, b.hr.means, b.lr.means), correct(m, kSh0, b.hr.sh0, b.lr.sh0);
      correct(m, kOpacities, b.hr.opacities, b.lr.opacities), correct(m, kScales, b.hr.scales, b.lr.scales);
      correct(m, kQuats, b.hr.quats, b.lr.quats);
      if (m.any[kShN]) m.of[kShN].store(shN_multiple);
    }
    if (moving) {  // still rows beside a moving one step too, which leaves them unchanged
      step_columns(s.means, b.lr.means, b.hr.means, i, count);
      step_columns(s.quats, b.lr.quats, b.hr.quats, i, count);
      step_columns(s.scales, b.lr.scales, b.hr.scales, i, count);
      step_columns(s.opacities, b.lr.opacities, b.hr.opacities, i, count);
      step_columns(s.sh0, b.lr.sh0, b.hr.sh0, i, count);
      step_detail(b, i, count);
      step_rows(b, i, count, moving, shN_multiple);
    }
    if (moving) return;
    for (int k = 0; k < count; ++k) rest_row(s.scales, i + k), rest_row(s.opacities, i + k), rest_row(s.detail, i + k);
    for (const Attribute* a : {&s.means, &s.quats, &s.scales, &s.opacities, &s.sh0, &s.detail, &s.shN}) fetch_next(*a, i, i + kLanes);
  }

  // Prefetches the rows that follow sixteen later. Spread over the step, because a processor has few loads under way at once.
  static CLEAR_INLINE void fetch_next(const Attribute& a, std::int64_t row, std::int64_t end) {
    for (const float* tensor : {a.p, a.m, a.v}) fetch_rows(tensor, row + kLanes, end + kLanes, a.width);
  }

  template <int D>
  CLEAR_INLINE void step_columns(const Attribute& a, const Floats (&l)[D], const Floats (&h)[D], std::int64_t i, int count) const {
    Floats merged[D];
    for (int d = 0; d < D; ++d) merged[d] = g.base ? l[d] + h[d] * Floats(s.lambda_hr) : l[d];  // Eq. 8
    float numbers[D * kLanes];
    join_rows(numbers, merged);
    step_numbers(s.adam, a, D * i, D * count, numbers);
    fetch_next(a, i, i + kLanes);
  }

  // f_det gets only the routed gradient of L_HF, uncorrected.
  void step_detail(const Block& b, std::int64_t i, int count) const {
    Floats none[3] = {0.0f, 0.0f, 0.0f}, routed[3] = {0.0f, 0.0f, 0.0f};
    if (g.hf)
      for (int d = 0; d < 3; ++d) routed[d] = b.hf.rgb[d] * b.m * Floats(g.lambda_hf);
    step_columns(s.detail, none, routed, i, count);
  }

  void step_rows(const Block& b, std::int64_t i, int count, std::uint32_t moving, const double (&correction)[kLanes]) const {
    if (!s.width) return;
    float m[kLanes], lr[4 * kLanes] = {}, base[4 * kLanes] = {}, hf[4 * kLanes] = {};  // padded, because reads are sixteen wide
    std::copy_n(g.lr.rgb + 3 * i, 3 * count, lr);
    if (g.base) std::copy_n(g.base.rgb + 3 * i, 3 * count, base);
    if (g.hf) std::copy_n(g.hf.rgb + 3 * i, 3 * count, hf), b.m.store(m);
    for (int k = 0; k < count; ++k) {
      fetch_next(s.shN, i + k, i + k + 1);
      if (!(moving >> k & 1)) continue;
      RowTables t{basis_row(g.lr, g.bases, i + k), {}, Floats::load(lr + 3 * k), Floats::load(base + 3 * k), Floats::load(hf + 3 * k)};
      if (g.base && g.base.basis != g.lr.basis) t.Y_hr = basis_row(g.base, g.bases, i + k);
      Floats gradient[3] = {0.0f, 0.0f, 0.0f};
      for (int v = 0; v < plan.sixteens; ++v)
        gradient[v] = expand(g, s, t, g.hf ? m[k] : 1, correction[k], plan.band[v], plan.channel[v]);
      step_row(i + k, gradient);
    }
  }

  CLEAR_INLINE void step_row(std::int64_t row, const Floats (&gradient)[3]) const {
    const Attribute& a = s.shN;
    std::int64_t at = row * a.width;
    if (a.merged || a.width < kLanes) {
      float numbers[3 * kLanes];
      for (int v = 0; v < plan.sixteens; ++v) gradient[v].store(numbers + plan.offset[v]);
      step_numbers(s.adam, a, at, plan.width, numbers);
    } else if (plan.sixteens == 3) {
      step_sixteens<3>(at, gradient);
    } else if (plan.sixteens == 2) {
      step_sixteens<2>(at, gradient);
    } else {
      step_sixteens<1>(at, gradient);
    }
  }

  template <int V>
  CLEAR_INLINE void step_sixteens(std::int64_t at, const Floats (&gradient)[3]) const {
    const Attribute& a = s.shN;
    Adam x[V];
    for (int v = 0; v < V; ++v) {
      std::int64_t from = at + plan.offset[v];
      x[v] = {Floats::load(a.p + from), Floats::load(a.m + from), Floats::load(a.v + from)};
    }
    for (int v = 0; v < V; ++v) {
      Floats total = gradient[v];
      if (a.anchor) total = with_anchor(a, total, x[v].p, Floats::load(a.anchor + at + plan.offset[v]));
      x[v].step(s.adam, a, total);
    }
    for (int v = 0; v < V; ++v) {
      std::int64_t to = at + plan.offset[v];
      x[v].p.store(a.p + to), x[v].m.store(a.m + to), x[v].v.store(a.v + to);
    }
  }

  // Still rows: gradient, moments and the anchor's gradient are all 0, so a step would not change them.
  std::uint32_t still_rows(const Block& b, std::int64_t i, std::uint32_t rows) const {
    Floats total = magnitude(b.lr);
    if (g.base) total += magnitude(b.hr);
    if (g.hf) total += magnitude(b.hf);
    std::uint32_t still = 0;
    for (std::uint32_t rest = (total <= Floats(0.0f)).bits() & rows; rest; rest &= rest - 1) {
      int k = __builtin_ctz(rest);
      if (is_still(i + k)) still |= 1u << k;
    }
    return still;
  }

  bool is_still(std::int64_t row) const {
    for (const Attribute* a : {&s.means, &s.quats, &s.scales, &s.opacities, &s.sh0, &s.detail})
      if (!clear::is_still(*a, row, a->width)) return false;
    return clear::is_still(s.shN, row, s.width);
  }

  template <int D>
  static CLEAR_INLINE Floats magnitude(const Floats (&columns)[D]) {
    Floats total = 0.0f;
    for (const Floats& c : columns) total += absolute(c);
    return total;
  }
  static CLEAR_INLINE Floats magnitude(const RawGradients& g) {
    return magnitude(g.means) + magnitude(g.quats) + magnitude(g.scales) + magnitude(g.opacities) + magnitude(g.rgb);
  }
};

}  // namespace

Stepped step(const Gradients& g, const Correction* correction, const Step& s, int threads) {
  std::vector<Stepped> parts(chunks(g.n));
  ChunkStep chunk_step(g, correction, s);
  Pool::instance().run(threads, std::int64_t(parts.size()), [&](std::int64_t k) { parts[k] = chunk_step.run(k); });
  Stepped total;
  for (const Stepped& part : parts) {
    total.conflicts.add(part.conflicts);
    total.still += part.still;
  }
  return total;
}

}  // namespace clear
