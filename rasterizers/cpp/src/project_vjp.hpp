// Adds up each Gaussian's pair sums in the order of its bins, and applies the VJP of the projection.
#pragma once

#include "blend.hpp"
#include "project.hpp"

namespace clear {

// The output: the fields of rasterizers.interface.SplatGradients, [K, n, …]; every element is written. `absgrad` may be null.
// With `weight` [n] the last cotangent counts so often and is added to the one before, see rasterizers.interface.summed_vjp: means,
// quats, scales and opacities are then [K - 1, n, …].
template <class T>
struct Gradients {
  T *means, *quats, *scales, *opacities, *screen, *rgb, *absgrad;
  const T* weight = nullptr;
};

// Zeroes the gradients of `count` Gaussians.
template <class T, int K>
void clear_gradients(std::int64_t n, std::int64_t first, std::int64_t count, const Gradients<T>& out) {
  auto zero = [&](T* tensor, int width, int rows = K) {
    for (int k = 0; k < rows; ++k) std::memset(tensor + (k * n + first) * width, 0, sizeof(T) * width * count);
  };
  const int sums = out.weight ? K - 1 : K;
  zero(out.means, 3, sums), zero(out.quats, 4, sums), zero(out.scales, 3, sums), zero(out.opacities, 1, sums);
  zero(out.screen, 2), zero(out.rgb, 3);
  if (out.absgrad) zero(out.absgrad, 2);
}

// Adds the pair sums of this band to the rows of each Gaussian of the group.
template <class Sums, class T, int R>
CLEAR_INLINE void add_pair_sums(const Bins& bins, const Group& group, const Sums* pair_sums, Lanes<T> (&rows)[R][kLanes]) {
  for (int i = 0; i < group.count; ++i)
    for (std::uint32_t p = bins.first[group.rows[i]]; p < bins.first[group.rows[i] + 1]; ++p)
      for (int r = 0; r < R; ++r) rows[r][i] += Lanes<T>::load(pair_sums[bins.where[p]].numbers + r * kLanes);
}

// Prefetches them for Gaussians that follow later: their addresses are scattered. One loop over the pairs of all, because the
// Gaussians between them have none, and one loop's end is predicted better than sixteen.
template <class Sums>
CLEAR_INLINE void fetch_pair_sums(const Bins& bins, const std::uint32_t* number, const std::uint32_t* end,
                                  const Sums* pair_sums) {
  if (number == end) return;
  for (std::uint32_t p = bins.first[*number]; p < bins.first[end[-1] + 1]; ++p)
    for (int r = 0; r < Sums::kRows; ++r) __builtin_prefetch(pair_sums[bins.where[p]].numbers + r * kLanes, 0, 1);
}

// Prefetches the rows that `project_vjp_group` reads of Gaussians that follow later, where these are not consecutive.
template <class T>
CLEAR_INLINE void fetch_rows(const Splats<T>& splats, const Target<T>& target, const Buffer<Slope<T>>& slopes,
                             const std::uint32_t* number, const std::uint32_t* end) {
  for (; number < end; ++number) {
    const std::size_t i = *number;
    __builtin_prefetch(splats.means + 3 * i), __builtin_prefetch(splats.quats + 4 * i);
    __builtin_prefetch(splats.scales + 3 * i), __builtin_prefetch(target.opacities + i);
    __builtin_prefetch(target.lit.data() + i);
    if (splats.bands) __builtin_prefetch(slopes[i].numbers);
  }
}

// The gradients of a group from its Gaussians' sums, `PairSums` in columns; those of its lanes that are not `touched` are zeros.
template <class T>
void project_vjp_group(const Pose& pose, const Settings<T>& s, const Splats<T>& splats, const Target<T>& target,
                       const Buffer<Slope<T>>& slopes, const Group& group, int K, Lanes<T>* sums, std::uint32_t touched,
                       const Gradients<T>& out) {
  using L = Lanes<T>;
  const Mask<T> real = Mask<T>::from_bits(touched);
  L mean[3], quat[4], scale[3], opacity[1];
  load_rows<3>(splats.means, group, mean);
  load_rows<4>(splats.quats, group, quat);
  load_rows<3>(splats.scales, group, scale);
  load_rows<1>(target.opacities, group, opacity);
  const Geometry<T> g(pose, target.grid, Centre(pose, mean), quat, scale);
  const Footprint<T> f(g, target.grid, s);
  std::uint8_t lit[kLanes];
  for (int i = 0; i < kLanes; ++i) lit[i] = target.lit[group.rows[i]];
  L slope[kLanes];
  if (splats.bands) {
    for (int i = 0; i < kLanes; ++i) slope[i] = L::load(slopes[group.rows[i]].numbers);
    transpose(slope);
  }
  auto keep = [&](auto& columns) {
    for (L& column : columns) column = where(real, column);
  };
  constexpr int width = PairSums<T, 1>::kWidth;
  for (int k = 0; k < K; ++k) {
    L screen[2];
    screen_vjp(f, sums[k * width + 1], sums[k * width + 2], screen);
    keep(screen);
    store_rows<2>(out.screen + 2 * k * splats.n, group, screen);
  }
  if (out.weight) {  // the projection is linear in the sums
    L weight[1], *last = sums + (K - 1) * width, *before = last - width;
    load_rows<1>(out.weight, group, weight);
    for (int i = 0; i < width; ++i) before[i] += last[i] *= weight[0];
  }
  for (int k = 0; k < K; ++k) {
    const L* sum = sums + k * width;
    const std::int64_t at = k * splats.n;
    L rgb[3];
    for (int c = 0; c < 3; ++c) rgb[c] = where(Mask<T>::from_bits(lanes_with_bit(lit, c)), sum[6 + c]);
    keep(rgb);
    store_rows<3>(out.rgb + 3 * at, group, rgb);
    if (out.weight && k == K - 1) break;
    LaneGradients<T> gradient;
    project_vjp(pose, target.grid, s, g, f, scale, opacity[0], sum[0], sum[1], sum[2], sum[3], sum[4], sum[5], gradient);
    for (int c = 0; c < 3 && splats.bands; ++c)
      for (int axis = 0; axis < 3; ++axis) gradient.mean[axis] += slope[3 * c + axis] * rgb[c];
    L alone[1] = {gradient.opacity};
    keep(gradient.mean), keep(gradient.quat), keep(gradient.scale), keep(alone);
    store_rows<3>(out.means + 3 * at, group, gradient.mean);
    store_rows<4>(out.quats + 4 * at, group, gradient.quat);
    store_rows<3>(out.scales + 3 * at, group, gradient.scale);
    store_rows<1>(out.opacities + at, group, alone);
    if (out.absgrad) {  // one cotangent
      L sums_of_absolutes[2] = {where(real, sum[6 + kColour]), where(real, sum[7 + kColour])};
      store_rows<2>(out.absgrad, group, sums_of_absolutes);
    }
  }
}

// Adds the gradients of the depths, in the group's `touched` lanes, to those of the centres.
template <class T>
void depth_vjp_group(const Pose& pose, const Group& group, const Lanes<T>& d_depth, std::uint32_t touched, T* d_means) {
  Lanes<T> mean[3];
  load_rows<3>(d_means, group, mean);
  for (int axis = 0; axis < 3; ++axis)
    mean[axis] += where(Mask<T>::from_bits(touched), Lanes<T>(T(pose.R[6 + axis])) * d_depth);
  store_rows<3>(d_means, group, mean);
}

}  // namespace clear
