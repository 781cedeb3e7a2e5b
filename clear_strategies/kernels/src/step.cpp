// Compiled with -ffp-contract=off: products and sums round as in torch, and multiply-adds are used only where torch uses
// them.
#include "step.hpp"

#include <numeric>
#include <vector>

#include "pool.hpp"
#include "sh_rows.hpp"

namespace clear {
namespace {

CLEAR_INLINE void group_products(const Gradients& g, const Block& b, std::int64_t i, int count, Products (&p)[kGroups]) {
  p[kMeans] = products(b.lr.means, b.hr.means);
  p[kSh0] = products(b.lr.sh0, b.hr.sh0);
  p[kOpacities] = products(b.lr.opacities, b.hr.opacities);
  p[kScales] = products(b.lr.scales, b.hr.scales);
  p[kQuats] = products(b.lr.quats, b.hr.quats);
  Doubles Y2 = higher_bands2(g.basis, g.bases, i, count);
  Products rgb = products(b.lr.rgb, b.hr.rgb);
  p[kShN] = {Y2 * rgb.dot, Y2 * rgb.l2, Y2 * rgb.h2};
}

class ChunkStep {
 public:
  ChunkStep(const Gradients& g, const Weights& w, const Step& s) : g(g), w(w), s(s), plan(s.width) {}

  // Returns the number of still rows.
  std::int64_t run(std::int64_t number) const {
    std::int64_t still = 0;
    each_sixteen(g.n, number, [&](std::int64_t i, int count) { still += sixteen(i, count); });
    return still;
  }

 private:
  const Gradients& g;
  const Weights& w;
  const Step& s;
  const RowPlan plan;

  int sixteen(std::int64_t i, int count) const {
    fetch(g, i + kLanes);
    Block b;
    load(g, i, count, b);
    std::uint32_t rows = first_bits(count);
    std::uint32_t still = s.skips ? still_rows(b, i, rows) : 0;
    std::uint32_t moving = rows & ~still;
    if (moving) {  // still rows beside a moving one step too, which leaves them unchanged
      if (g.hr && s.lambda_hr > 0) merge(b, i, count);
      step_columns(s.means, b.lr.means, i, count), step_columns(s.quats, b.lr.quats, i, count);
      step_columns(s.scales, b.lr.scales, i, count), step_columns(s.opacities, b.lr.opacities, i, count);
      step_columns(s.sh0, b.lr.sh0, i, count);
      step_detail(b, i, count);
      step_rows(b, i, count, moving);
      return __builtin_popcount(still);
    }
    for (int k = 0; k < count; ++k) rest_row(s.scales, i + k), rest_row(s.opacities, i + k), rest_row(s.detail, i + k);
    for (const Attribute* a : {&s.means, &s.quats, &s.scales, &s.opacities, &s.sh0, &s.detail, &s.shN}) fetch_next(*a, i, i + kLanes);
    return __builtin_popcount(still);
  }

  // g_LR becomes g_LR + λ_HR ĝ_HR, and is that of shN as the colours beside Y.
  CLEAR_INLINE void merge(Block& b, std::int64_t i, int count) const {
    add(kMeans, b.lr.means, b.hr.means, i, count), add(kSh0, b.lr.sh0, b.hr.sh0, i, count);
    add(kOpacities, b.lr.opacities, b.hr.opacities, i, count), add(kScales, b.lr.scales, b.hr.scales, i, count);
    add(kQuats, b.lr.quats, b.hr.quats, i, count), add(kShN, b.lr.rgb, b.hr.rgb, i, count);
  }

  template <int D>
  CLEAR_INLINE void add(Group group, Floats (&l)[D], Floats (&h)[D], std::int64_t i, int count) const {
    reconcile(w, group, h, l, i, count);
    for (int d = 0; d < D; ++d) l[d] += h[d] * Floats(s.lambda_hr);
  }

  // Prefetches the rows that follow sixteen later. Spread over the step, because a processor has few loads under way at once.
  static CLEAR_INLINE void fetch_next(const Attribute& a, std::int64_t row, std::int64_t end) {
    for (const float* tensor : {a.p, a.m, a.v}) fetch_rows(tensor, row + kLanes, end + kLanes, a.width);
  }

  template <int D>
  CLEAR_INLINE void step_columns(const Attribute& a, const Floats (&merged)[D], std::int64_t i, int count) const {
    float numbers[D * kLanes];
    join_rows(numbers, merged);
    step_numbers(s.adam, a, s.lambda_hr, D * i, D * count, numbers);
    fetch_next(a, i, i + kLanes);
  }

  // f_det gets only the routed gradient of L_HF, uncorrected.
  void step_detail(const Block& b, std::int64_t i, int count) const {
    Floats weighted[3] = {0.0f, 0.0f, 0.0f};
    if (g.detail)
      for (int d = 0; d < 3; ++d) weighted[d] = b.detail[d] * Floats(s.lambda_hr);
    step_columns(s.detail, weighted, i, count);
  }

  void step_rows(const Block& b, std::int64_t i, int count, std::uint32_t moving) const {
    if (!s.width) return;
    float colours[4 * kLanes] = {};  // padded, because reads are sixteen wide
    join_rows(colours, b.lr.rgb);
    for (int k = 0; k < count; ++k) {
      fetch_next(s.shN, i + k, i + k + 1);
      if (!(moving >> k & 1)) continue;
      Floats Y = load_some(g.basis + g.bases * (i + k), g.bases), rgb = Floats::load(colours + 3 * k), gradient[3] = {0.0f, 0.0f, 0.0f};
      for (int v = 0; v < plan.sixteens; ++v) gradient[v] = outer(Y, rgb, plan, v);
      step_row(i + k, gradient);
    }
  }

  CLEAR_INLINE void step_row(std::int64_t row, const Floats (&gradient)[3]) const {
    const Attribute& a = s.shN;
    std::int64_t at = row * a.width;
    if (a.width < kLanes) {
      float numbers[3 * kLanes];
      for (int v = 0; v < plan.sixteens; ++v) gradient[v].store(numbers + plan.offset[v]);
      step_numbers(s.adam, a, s.lambda_hr, at, plan.width, numbers);
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
    for (int v = 0; v < V; ++v) x[v].step(s.adam, a, with_given(a, gradient[v], s.lambda_hr, at + plan.offset[v], kLanes));
    for (int v = 0; v < V; ++v) {
      std::int64_t to = at + plan.offset[v];
      x[v].p.store(a.p + to), x[v].m.store(a.m + to), x[v].v.store(a.v + to);
    }
  }

  // Still rows: gradients and moments are all 0, so a step would not change them.
  std::uint32_t still_rows(const Block& b, std::int64_t i, std::uint32_t rows) const {
    Floats total = magnitude(b.lr);
    if (g.hr) total += magnitude(b.hr);
    if (g.detail) total += magnitude(b.detail);
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

Conflicts products(const Gradients& g, ProductTable to, int threads) {
  std::vector<Conflicts> parts(chunks(g.n));
  Pool::instance().run(threads, std::int64_t(parts.size()), [&](std::int64_t number) {
    each_sixteen(g.n, number, [&](std::int64_t i, int count) {
      fetch(g, i + kLanes);
      Block b;
      load(g, i, count, b);
      Products p[kGroups];
      group_products(g, b, i, count, p);
      to.write(p, i, count, parts[number]);
    });
  });
  Conflicts total;
  for (const Conflicts& part : parts) total.add(part);
  return total;
}

std::int64_t step(const Gradients& g, const Weights& w, const Step& s, int threads) {
  std::vector<std::int64_t> still(chunks(g.n));
  ChunkStep chunk(g, w, s);
  Pool::instance().run(threads, chunks(g.n), [&](std::int64_t k) { still[k] = chunk.run(k); });
  return std::accumulate(still.begin(), still.end(), std::int64_t(0));
}

}  // namespace clear
