// Projects every group of sixteen Gaussians onto each pixel grid of a pose, and computes the colours of the visible ones.
#pragma once

#include "bins.hpp"
#include "colour.hpp"
#include "columns.hpp"
#include "pool.hpp"

namespace clear {

// Colours, before offset and clamp, and ∂rgb/∂mean of the Gaussians that are visible on some grid; by group.
template <class T>
struct Palette {
  static constexpr int kRgb = 3 * kLanes, kSlope = 9 * kLanes;
  Buffer<T> rgb, slope;  // [groups, 3, 16], [groups, 9, 16]

  void reserve(std::int64_t groups, bool turns) {
    rgb.reserve_lost(groups * kRgb);
    slope.reserve_lost(turns ? groups * kSlope : 0);  // without higher bands the colour does not depend on the position
  }
};

// One pixel grid of a pose: what differs between them, and the result of the projection.
template <class T>
struct Target {
  Grid<T> grid;
  const T* opacities;   // [n]
  const T* rgb_offset;  // [n, 3] or null
  T* means2d;           // out [n, 2]
  bool* visible;        // out [n]
  std::vector<std::uint64_t> requested;  // the requested blocks of each bin; empty: all
  Buffer<Ellipse<T>> ellipses;
  Buffer<BinRange> ranges;    // [n]
  Buffer<std::uint16_t> lit;  // [groups, 3]: the lanes whose channel was not clamped at 0, and so has a gradient
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

// The visible Gaussians with a requested bin; the ranges of the others become empty.
template <class T>
std::uint32_t keep_requested(const Target<T>& target, std::uint32_t shown, BinRange* ranges) {
  if (target.requested.empty()) return shown;
  std::uint32_t requested = 0;
  for (std::uint32_t m = shown; m; m &= m - 1) {
    const int i = __builtin_ctz(m);
    bool any = false;
    for (int y = ranges[i].y0; y <= ranges[i].y1 && !any; ++y)
      for (int x = ranges[i].x0; x <= ranges[i].x1 && !any; ++x) any = target.requested[y * target.grid.columns() + x] != 0;
    if (any) requested |= 1u << i;
    else ranges[i] = BinRange{};
  }
  return requested;
}

inline std::int64_t groups_of(std::int64_t n) { return (n + kLanes - 1) / kLanes; }

// Whether the minimum of A dx² + B dx dy + C dy² over the box of the image's pixel centres is within reach; exact. A convex
// quadratic has its minimum over a box at its centre if that is inside, else on one of the sides that face the centre.
template <class T>
CLEAR_INLINE Mask<T> reaches_image(const Grid<T>& s, const Lanes<T>& u, const Lanes<T>& v, const Lanes<T>& A,
                                   const Lanes<T>& B, const Lanes<T>& C, const Lanes<T>& reach) {
  using L = Lanes<T>;
  L left = L(T(0.5)) - u, right = L(T(s.width) - T(0.5)) - u, top = L(T(0.5)) - v, bottom = L(T(s.height) - T(0.5)) - v;
  L near_x = clamp(L(T(0)), left, right), near_y = clamp(L(T(0)), top, bottom);
  L on_x = clamp(-B * near_x / (L(T(2)) * C), top, bottom), on_y = clamp(-B * near_y / (L(T(2)) * A), left, right);
  auto power = [&](const L& dx, const L& dy) { return A * dx * dx + B * dx * dy + C * dy * dy; };
  return minimum(power(near_x, on_x), power(on_y, near_y)) <= reach;
}

// One group's ellipses on one grid; returns the visible lanes. The conditions say what is kept, because NaN fails each.
template <class T>
CLEAR_INLINE Mask<T> ellipse_of(const Centre& centre, const Geometry<T>& g, const Grid<T>& grid,
                                const Settings<T>& s, const Lanes<T>& opacity, Lanes<T> (&e)[kLanes]) {
  using L = Lanes<T>;
  Footprint<T> f(g, grid, s);
  constexpr T log2e = kLog2E<T>;
  using D = Lanes<double>;
  const D exact_u = D(grid.fx) * centre.tan_x + D(grid.cx), exact_v = D(grid.fy) * centre.tan_y + D(grid.cy);
  const D whole_u = nearest(exact_u), whole_v = nearest(exact_v);
  const L u = convert<T>(exact_u), v = convert<T>(exact_v);
  L A = L(log2e / 2) * f.xx, B = L(log2e) * f.xy, C = L(log2e / 2) * f.yy;
  L peak = log2(maximum(opacity * f.compensation, L(T(1e-30))));
  L reach = (peak - L(std::log2(s.alpha_min))) * L(T(1.001)) + L(T(1e-3) * log2e);
  L extent = root(maximum(reach, L(T(0))) * L(2 / log2e)) * f.size;
  L half_x = extent * root(f.a + f.kernel), half_y = extent * root(f.c + f.kernel);
  constexpr T huge = T(1e30);  // such an ellipse, of 1e-15 px, covers no pixel centre, and the square would overflow
  Mask<T> shows = (g.z > L(s.near)) & (opacity >= L(s.alpha_min)) & (reach > L(T(0))) & (A < L(huge)) & (C < L(huge)) &
                  (absolute(u) < L(huge)) & (absolute(v) < L(huge)) & (half_x >= L(T(0))) & (half_y >= L(T(0))) &
                  reaches_image(grid, u, v, A, B, C, reach);
  e[kU] = convert<T>(exact_u - whole_u), e[kV] = convert<T>(exact_v - whole_v);
  e[kWholeU] = convert<T>(whole_u), e[kWholeV] = convert<T>(whole_v);
  e[kA] = A, e[kB] = B, e[kC] = C, e[kPeak] = peak, e[kReach] = select(shows, reach, L(T(-1)));
  e[kHalfX] = half_x, e[kHalfY] = half_y;
  return shows;
}

// Leaves `poison` 0 for finite numbers and NaN otherwise: NaN and infinity times 0 are NaN.
template <class T>
CLEAR_INLINE void add_times_zero(const Lanes<T>* columns, int count, Lanes<T>& poison) {
  for (int i = 0; i < count; ++i) poison += columns[i] * Lanes<T>(T(0));
}

// Returns whether every number that was read is finite.
template <class T>
bool project_group(const Pose& pose, const Settings<T>& s, const Splats<T>& splats, std::vector<Target<T>>& targets,
                   Palette<T>& palette, Buffer<double>& depths, std::int64_t group) {
  using L = Lanes<T>;
  const std::int64_t first = group * kLanes;
  const int count = int(std::min<std::int64_t>(kLanes, splats.n - first));
  const std::uint32_t real = (1u << count) - 1;
  L mean[3], quat[4], scale[3];
  load_rows<3>(splats.means, first, count, mean);
  load_rows<4>(splats.quats, first, count, quat);
  load_rows<3>(splats.scales, first, count, scale);
  L poison = T(0);
  add_times_zero(mean, 3, poison), add_times_zero(quat, 4, poison), add_times_zero(scale, 3, poison);
  const Centre centre(pose, mean);
  const Geometry<T> g(pose, targets[0].grid, centre, quat, scale);

  centre.z.store(depths.data() + first);
  Mask<T> in_front = g.z > L(s.near);
  L ellipse[4][kLanes];
  std::uint32_t shown[4], any = 0;  // visible, and on a requested bin
  for (std::size_t i = 0; i < targets.size(); ++i) {
    Target<T>& target = targets[i];
    const L opacity = load_row(target.opacities, first, count);
    add_times_zero(&opacity, 1, poison);
    // The grids of one pose are nearly always scaled copies of each other; they then share the geometry, too.
    Mask<T> shows = same_view(target.grid, targets[0].grid)
                        ? ellipse_of(centre, g, target.grid, s, opacity, ellipse[i])
                        : ellipse_of(centre, Geometry<T>(pose, target.grid, centre, quat, scale), target.grid, s,
                                     opacity, ellipse[i]);
    const std::uint32_t visible = shows.bits() & real;
    const L uv[2] = {where(in_front, ellipse[i][kWholeU] + ellipse[i][kU]),
                     where(in_front, ellipse[i][kWholeV] + ellipse[i][kV])};
    store_rows<2>(target.means2d, first, count, uv);
    store_bits(target.visible + first, count, visible);
    bins_of(target.grid, ellipse[i], visible, count, target.ranges.data() + first);
    any |= shown[i] = keep_requested(target, visible, target.ranges.data() + first);
  }

  Colour<T> colour;
  if (any) {
    L coefficients[3 * 16];
    const T *base[kLanes], *bands[kLanes];
    for (int i = 0; i < kLanes; ++i) {
      bool used = (any >> i) & 1;
      base[i] = used ? splats.sh0 + 3 * (first + i) : nullptr;
      bands[i] = used && splats.bands ? splats.shN + splats.shN_stride * (first + i) : nullptr;
    }
    gather_rows(base, 3, coefficients);
    if (splats.bands) gather_rows(bands, 3 * splats.bands, coefficients + 3);
    add_times_zero(coefficients, 3 + 3 * splats.bands, poison);
    colour_of(pose, mean, splats.bands, coefficients, colour);
    for (int c = 0; c < 3; ++c) colour.rgb[c].store(palette.rgb.data() + group * palette.kRgb + c * kLanes);
    if (splats.bands)
      for (int c = 0; c < 9; ++c) colour.slope[c].store(palette.slope.data() + group * palette.kSlope + c * kLanes);
  }

  for (std::size_t i = 0; i < targets.size(); ++i) {
    L(&e)[kLanes] = ellipse[i];
    L offset[3] = {T(0), T(0), T(0)};
    if (targets[i].rgb_offset && shown[i]) load_rows<3>(targets[i].rgb_offset, first, count, offset);
    add_times_zero(offset, 3, poison);
    for (int c = 0; c < 3; ++c) {
      L rgb = any ? colour.rgb[c] + offset[c] : L(T(0));
      e[kRed + c] = maximum(rgb, L(T(0)));
      targets[i].lit[3 * group + c] = std::uint16_t((rgb >= L(T(0))).bits());
    }
    e[14] = e[15] = T(0);
    transpose(e);
    T* rows = reinterpret_cast<T*>(targets[i].ellipses.data() + first);
    for (int k = 0; k < kLanes; ++k) e[k].store(rows + k * kLanes);
  }
  return (poison >= L(T(0))).bits() == 0xffff;
}

// Allocates whole groups; the rows beyond n repeat the last Gaussian and are never listed.
template <class T>
bool project(const Pose& pose, const Settings<T>& s, const Splats<T>& splats, std::vector<Target<T>>& targets,
             Palette<T>& palette, Buffer<double>& depths, int threads) {
  const std::int64_t groups = groups_of(splats.n), per_task = 64;
  palette.reserve(groups, splats.bands > 0);
  depths.reserve_lost(groups * kLanes);
  for (Target<T>& target : targets) {
    target.ranges.reserve_lost(splats.n);
    target.ellipses.reserve_lost(groups * kLanes);
    target.lit.reserve_lost(groups * 3);
  }
  std::atomic<bool> finite{true};
  Pool::instance().run(threads, (groups + per_task - 1) / per_task, [&](std::int64_t task) {
    for (std::int64_t g = task * per_task; g < std::min(groups, (task + 1) * per_task); ++g)
      if (!project_group(pose, s, splats, targets, palette, depths, g)) finite = false;
  });
  return finite;
}

}  // namespace clear
