// Adds up each Gaussian's pair sums in the order of its bins, and applies the VJP of the projection.
#pragma once

#include "blend.hpp"
#include "project.hpp"

namespace clear {

// The output: the fields of rasterizers.interface.SplatGradients, [K, n, …]; every element is written.
template <class T>
struct Gradients {
  T *means, *quats, *scales, *opacities, *screen, *rgb;
};

// Adds the pair sums of this band to the K rows of each Gaussian of a group. Their addresses are scattered, so those of
// later groups are prefetched.
template <class T, int K>
CLEAR_INLINE void add_pair_sums(const Bins& bins, std::int64_t first, int count, std::int64_t n,
                           const Buffer<PairSums<T>>& pair_sums, Lanes<T> (&rows)[K][kLanes]) {
  constexpr std::int64_t ahead = 6 * kLanes;
  const std::uint32_t* mine = bins.first.data();
  for (std::uint32_t p = mine[std::min(n, first + ahead)]; p < mine[std::min(n, first + ahead + kLanes)]; ++p)
    for (int k = 0; k < K; ++k) __builtin_prefetch(&pair_sums[std::size_t(bins.where[p]) * K + k], 0, 1);
  for (int i = 0; i < count; ++i)
    for (std::uint32_t p = mine[first + i]; p < mine[first + i + 1]; ++p)
      for (int k = 0; k < K; ++k) rows[k][i] += Lanes<T>::load(&pair_sums[std::size_t(bins.where[p]) * K + k].q);
}

template <class T, int K>
void project_vjp_group(const Pose& pose, const Settings<T>& s, const Splats<T>& splats, const Target<T>& target,
                const Palette<T>& palette, std::int64_t group, Lanes<T> (&rows)[K][kLanes], std::uint32_t touched,
                const Gradients<T>& out) {
  using L = Lanes<T>;
  const std::int64_t n = splats.n, first = group * kLanes;
  const int count = int(std::min<std::int64_t>(kLanes, n - first));
  if (!touched) {
    auto clear = [&](T* tensor, int width) {
      for (int k = 0; k < K; ++k) std::memset(tensor + (k * n + first) * width, 0, sizeof(T) * width * count);
    };
    clear(out.means, 3), clear(out.quats, 4), clear(out.scales, 3), clear(out.opacities, 1), clear(out.screen, 2);
    clear(out.rgb, 3);
    return;
  }
  const Mask<T> real = Mask<T>::from_bits(touched);
  L mean[3], quat[4], scale[3];
  load_rows<3>(splats.means, first, count, mean);
  load_rows<4>(splats.quats, first, count, quat);
  load_rows<3>(splats.scales, first, count, scale);
  const L opacity = load_row(target.opacities, first, count);
  const Geometry<T> g(pose, target.grid, Centre(pose, mean), quat, scale);
  const Footprint<T> f(g, target.grid, s);
  for (int k = 0; k < K; ++k) {
    L(&sum)[kLanes] = rows[k];
    transpose(sum);
    LaneGradients<T> gradient;
    project_vjp(pose, target.grid, s, g, f, scale, opacity, sum[0], sum[1], sum[2], sum[3], sum[4], sum[5], gradient);
    L rgb[3];
    for (int c = 0; c < 3; ++c) {
      rgb[c] = where(Mask<T>::from_bits(target.lit[3 * group + c]), sum[6 + c]);
      if (!splats.bands) continue;
      const T* slope = palette.slope.data() + group * palette.kSlope + 3 * c * kLanes;
      for (int axis = 0; axis < 3; ++axis) gradient.mean[axis] += L::load(slope + axis * kLanes) * rgb[c];
    }
    auto keep = [&](auto& columns) {
      for (L& column : columns) column = where(real, column);
    };
    L alone[1] = {gradient.opacity};
    keep(gradient.mean), keep(gradient.quat), keep(gradient.scale), keep(gradient.screen), keep(rgb), keep(alone);
    const std::int64_t row = k * n + first;
    store_rows<3>(out.means, row, count, gradient.mean);
    store_rows<4>(out.quats, row, count, gradient.quat);
    store_rows<3>(out.scales, row, count, gradient.scale);
    store_rows<1>(out.opacities, row, count, alone);
    store_rows<2>(out.screen, row, count, gradient.screen);
    store_rows<3>(out.rgb, row, count, rgb);
  }
}

}  // namespace clear
