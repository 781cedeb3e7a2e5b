// Projects every group of sixteen Gaussians onto each pixel grid of a pose, and computes the colours of those that are drawn.
#pragma once

#include "bins.hpp"
#include "colour.hpp"
#include "columns.hpp"
#include "pool.hpp"

namespace clear {

// rasterizers.geometry.BLACK: a colour of 0 comes out this much below it by rounding, and still gets its gradient.
template <class T>
inline constexpr T kBlack = T(1e-6);

// ∂rgb/∂mean of a drawn Gaussian, channel by channel: one register, so that any sixteen of them are read by a transpose.
template <class T>
struct alignas(kLanes * sizeof(T)) Slope {
  T numbers[kLanes];
};

// One pixel grid of a pose: what differs between them, and the result of the projection.
template <class T>
struct Target {
  Grid<T> grid;
  const T* opacities;   // [n]
  const T* rgb_offset;  // [n, 3] or null
  T* means2d;           // out [n, 2]
  bool* visible;        // out [n]
  Buffer<BinRange> ranges;       // [n]; empty if the Gaussian is not drawn
  Buffer<Ellipse<T>> ellipses;   // [n]; of the drawn Gaussians
  Buffer<std::uint8_t> lit;      // [n]; bit c: channel c was not clamped at 0, and so has a gradient
  std::int64_t pairs = 0;        // of a Gaussian and a bin; 64-bit: a million Gaussians that cover the image make 10^9
};

// The bins whose pixel centres the ellipses' boxes cover.
template <class T>
CLEAR_INLINE void bins_of(const Grid<T>& grid, const Lanes<T> (&e)[kLanes], std::uint32_t shown, int count,
                          BinRange* out) {
  using L = Lanes<T>;
  auto bin = [](const L& pixel, int size, T (&store)[kLanes]) CLEAR_LAMBDA {
    floor(clamp(pixel, L(T(0)), L(T(size - 1))) * L(T(1) / kBin)).store(store);
  };
  const L half = T(0.5);
  T x0[kLanes], x1[kLanes], y0[kLanes], y1[kLanes];
  const L u = e[kWholeU] + e[kU] - half, v = e[kWholeV] + e[kV] - half;
  bin(u - e[kHalfX], grid.width, x0), bin(u + e[kHalfX], grid.width, x1);
  bin(v - e[kHalfY], grid.height, y0), bin(v + e[kHalfY], grid.height, y1);
  for (int i = 0; i < count; ++i)
    out[i] = (shown >> i) & 1 ? BinRange{std::int16_t(x0[i]), std::int16_t(x1[i]), std::int16_t(y0[i]), std::int16_t(y1[i])}
                              : BinRange{};
}

// Whether the minimum of A (dx + S dy)² + D dy² over the box of the image's pixel centres is within reach; exact. A convex
// quadratic has its minimum over a box at its centre if that is inside, else on one of the sides that face the centre.
template <class T>
CLEAR_INLINE Mask<T> reaches_image(const Grid<T>& s, const Lanes<T>& u, const Lanes<T>& v, const Lanes<T>& A,
                                   const Lanes<T>& S, const Lanes<T>& D, const Lanes<T>& reach) {
  using L = Lanes<T>;
  L left = L(T(0.5)) - u, right = L(T(s.width) - T(0.5)) - u, top = L(T(0.5)) - v, bottom = L(T(s.height) - T(0.5)) - v;
  L near_x = clamp(L(T(0)), left, right), near_y = clamp(L(T(0)), top, bottom);
  L on_x = clamp(-A * S * near_x / (A * S * S + D), top, bottom), on_y = clamp(-S * near_y, left, right);
  auto power = [&](const L& dx, const L& dy) { return A * (dx + S * dy) * (dx + S * dy) + D * dy * dy; };
  return minimum(power(near_x, on_x), power(on_y, near_y)) <= reach;
}

// One group's ellipses on one grid; returns the visible lanes. The conditions say what is kept, because NaN fails each.
template <class T>
CLEAR_INLINE Mask<T> ellipse_of(const Centre& centre, const Geometry<T>& g, const Grid<T>& grid,
                                const Settings<T>& s, const Lanes<T>& opacity, Lanes<T> (&e)[kLanes]) {
  using L = Lanes<T>;
  Footprint<T> f(g, grid, s);
  constexpr T log2e = kLog2E<T>;
  using Exact = Lanes<double>;
  const Exact exact_u = Exact(grid.fx) * centre.tan_x + Exact(grid.cx), exact_v = Exact(grid.fy) * centre.tan_y + Exact(grid.cy);
  const Exact whole_u = nearest(exact_u), whole_v = nearest(exact_v);
  const L u = convert<T>(exact_u), v = convert<T>(exact_v);
  const L A = L(log2e / 2) * f.A, S = f.S, D = L(log2e / 2) * f.D;
  L peak = log2(maximum(opacity * f.compensation, L(T(1e-30))));
  L reach = (peak - L(s.log2_alpha_min)) * L(T(1.001)) + L(T(1e-3) * log2e);
  L extent = root(maximum(reach, L(T(0))) * L(2 / log2e)) * f.size;
  L half_x = extent * root(f.a + f.kernel), half_y = extent * root(f.c + f.kernel);
  constexpr T huge = T(1e30);  // such an ellipse, of 1e-15 px, covers no pixel centre, and the square would overflow
  Mask<T> shows = (g.z > L(s.near)) & (opacity >= L(s.alpha_min)) & (reach > L(T(0))) & (A < L(huge)) & (A * S * S + D < L(huge)) &
                  (absolute(u) < L(huge)) & (absolute(v) < L(huge)) & (half_x >= L(T(0))) & (half_y >= L(T(0))) &
                  reaches_image(grid, u, v, A, S, D, reach);
  e[kU] = convert<T>(exact_u - whole_u), e[kV] = convert<T>(exact_v - whole_v);
  e[kWholeU] = convert<T>(whole_u), e[kWholeV] = convert<T>(whole_v);
  e[kA] = A, e[kS] = S, e[kD] = D, e[kPeak] = peak, e[kReach] = select(shows, reach, L(T(-1)));
  e[kHalfX] = half_x, e[kHalfY] = half_y;
  return shows;
}

// Leaves `poison` 0 for finite numbers and NaN otherwise: NaN and infinity times 0 are NaN.
template <class T>
CLEAR_INLINE void add_times_zero(const Lanes<T>* columns, int count, Lanes<T>& poison) {
  for (int i = 0; i < count; ++i) poison += columns[i] * Lanes<T>(T(0));
}

// Prefetches a group's rows. They are consecutive, but in more streams than the hardware prefetches.
template <class T>
CLEAR_INLINE void fetch_group(const Splats<T>& splats, std::int64_t first) {
  auto fetch = [&](const T* rows, int width) {
    for (std::size_t at = 0; at < sizeof(T) * width * kLanes; at += 64)
      __builtin_prefetch(reinterpret_cast<const char*>(rows + width * first) + at);
  };
  fetch(splats.means, 3), fetch(splats.quats, 4), fetch(splats.scales, 3);
}

// Projects the sixteen Gaussians from `first` on, and returns those that some grid draws, as bits. `finite` becomes false if
// a number that was read is not.
template <class T>
std::uint32_t project_group(const Pose& pose, const Settings<T>& s, const Splats<T>& splats, std::vector<Target<T>>& targets,
                            Buffer<double>& depths, std::int64_t first, bool& finite) {
  using L = Lanes<T>;
  const int count = int(std::min<std::int64_t>(kLanes, splats.n - first));
  const std::uint32_t real = (1u << count) - 1;
  fetch_group(splats, first + 4 * kLanes);
  L mean[3], quat[4], scale[3];
  load_rows<3>(splats.means, first, count, mean);
  load_rows<4>(splats.quats, first, count, quat);
  load_rows<3>(splats.scales, first, count, scale);
  L poison = T(0);
  add_times_zero(mean, 3, poison), add_times_zero(quat, 4, poison), add_times_zero(scale, 3, poison);
  const Centre centre(pose, mean);
  Geometry<T> g(pose, targets[0].grid, centre, quat, scale);
  const Grid<T>* placed = &targets[0].grid;

  centre.z.store(depths.data() + first);
  const Mask<T> in_front = g.z > L(s.near);
  std::uint32_t any = 0;
  for (Target<T>& target : targets) {
    L opacity[1];
    load_rows<1>(target.opacities, first, count, opacity);
    add_times_zero(opacity, 1, poison);
    // The grids of one pose are nearly always scaled copies of each other; they then share the geometry, too. There is one
    // call, because two copies of inlined code may round differently.
    if (!target.grid.same_view(*placed)) g.place(target.grid), placed = &target.grid;
    L e[kLanes];
    const Mask<T> shows = ellipse_of(centre, g, target.grid, s, opacity[0], e);
    const std::uint32_t visible = shows.bits() & real;
    const L uv[2] = {where(in_front, e[kWholeU] + e[kU]), where(in_front, e[kWholeV] + e[kV])};
    store_rows<2>(target.means2d, first, count, uv);
    for (int i = 0; i < count; ++i) target.visible[first + i] = (visible >> i) & 1;
    bins_of(target.grid, e, visible, count, target.ranges.data() + first);
    any |= visible;
    if (!visible) continue;
    e[kRed] = e[kGreen] = e[kBlue] = e[15] = T(0);  // the colour is written by `colour_group`
    e[kDepth] = g.z;
    transpose(e);
    each_bit(visible, [&](int i) CLEAR_LAMBDA { e[i].store(&target.ellipses[first + i].u); });
  }
  finite &= (poison >= L(T(0))).bits() == 0xffff;
  return any;
}

// Prefetches a Gaussian's coefficients, which `colour_group` reads after the rest of the chunk has been projected.
template <class T>
CLEAR_INLINE void fetch_coefficients(const Splats<T>& splats, std::uint32_t number) {
  __builtin_prefetch(splats.sh0 + 3 * std::size_t(number), 0, 2);
  if (!splats.bands) return;
  const T* row = splats.shN + splats.shN_stride * number;
  constexpr int line = 64 / sizeof(T);
  for (int i = 0; i < 3 * splats.bands; i += line) __builtin_prefetch(row + i, 0, 2);
  __builtin_prefetch(row + 3 * splats.bands - 1, 0, 2);
}

// Writes the colours of a group of drawn Gaussians into their ellipses on every grid.
template <class T>
void colour_group(const Pose& pose, const Splats<T>& splats, std::vector<Target<T>>& targets, Buffer<Slope<T>>& slopes,
                  const Group& group, bool& finite) {
  using L = Lanes<T>;
  L mean[3], coefficients[3 * 16], poison = T(0);
  load_rows<3>(splats.means, group, mean);
  L base[3];
  load_rows<3>(splats.sh0, group, base);
  std::copy(base, base + 3, coefficients);
  load_rows(splats.shN, splats.shN_stride, group, 3 * splats.bands, coefficients + 3);
  add_times_zero(coefficients, 3 + 3 * splats.bands, poison);
  Colour<T> colour;
  colour_of(pose, mean, splats.bands, coefficients, colour);
  for (Target<T>& target : targets) {
    L rgb[3] = {colour.rgb[0], colour.rgb[1], colour.rgb[2]};
    if (target.rgb_offset) {
      L offset[3];
      load_rows<3>(target.rgb_offset, group, offset);
      add_times_zero(offset, 3, poison);
      for (int c = 0; c < 3; ++c) rgb[c] += offset[c];
    }
    T clamped[3][kLanes];
    std::uint32_t lit[3];
    for (int c = 0; c < 3; ++c) {
      maximum(rgb[c], L(T(0))).store(clamped[c]);
      lit[c] = (rgb[c] >= L(-kBlack<T>)).bits();
    }
    for (int i = 0; i < group.count; ++i) {
      Ellipse<T>& e = target.ellipses[group.rows[i]];
      e.r = clamped[0][i], e.g = clamped[1][i], e.b = clamped[2][i];
      target.lit[group.rows[i]] = std::uint8_t((lit[0] >> i & 1) | (lit[1] >> i & 1) << 1 | (lit[2] >> i & 1) << 2);
    }
  }
  if (splats.bands) {  // without higher bands the colour does not depend on the position
    L rows[kLanes];
    for (int c = 0; c < kLanes; ++c) rows[c] = c < 9 ? colour.slope[c] : L(T(0));
    transpose(rows);
    for (int i = 0; i < group.count; ++i) rows[i].stream(slopes[group.rows[i]].numbers);
  }
  finite &= (poison >= L(T(0))).bits() == 0xffff;
}

// Returns whether every number that was read is finite.
template <class T>
bool project(const Pose& pose, const Settings<T>& s, const Splats<T>& splats, std::vector<Target<T>>& targets,
             Buffer<Slope<T>>& slopes, Buffer<double>& depths, Drawn& drawn, int threads) {
  const std::int64_t n = splats.n;
  slopes.reserve_lost(splats.bands ? n : 0);
  depths.reserve_lost(groups_of(n) * kLanes);  // whole groups are written
  drawn.reserve(n);
  for (Target<T>& target : targets) {
    target.ranges.reserve_lost(n);
    target.ellipses.reserve_lost(n);
    target.lit.reserve_lost(n);
  }
  std::atomic<bool> all_finite{true};
  std::vector<std::atomic<std::int64_t>> pairs(targets.size());
  Pool::instance().run(threads, chunks_of(n), [&](std::int64_t chunk) {
    bool finite = true;
    std::uint32_t* numbers = drawn.open(chunk);
    std::int64_t count = 0;
    for (std::int64_t first = chunk * kChunk; first < std::min(n, (chunk + 1) * kChunk); first += kLanes)
      each_bit(project_group(pose, s, splats, targets, depths, first, finite), [&](int i) CLEAR_LAMBDA {
        numbers[count] = std::uint32_t(first + i);
        fetch_coefficients(splats, numbers[count++]);
      });
    drawn.close(chunk, count);
    for (std::size_t i = 0; i < targets.size(); ++i) {
      std::int64_t here = 0;
      for (std::int64_t k = 0; k < count; ++k) here += targets[i].ranges[numbers[k]].count();
      pairs[i] += here;
    }
    for (std::int64_t k = 0; k < count; k += kLanes)
      colour_group(pose, splats, targets, slopes, Group(numbers + k, count - k), finite);
    end_of_stream();
    if (!finite) all_finite = false;
  });
  for (std::size_t i = 0; i < targets.size(); ++i) targets[i].pairs = pairs[i];
  return all_finite;
}

}  // namespace clear
