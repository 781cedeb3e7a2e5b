// What the stages hand to each other. `T` is float, or double for checking.
#pragma once

#include <cstdint>
#include <vector>

#include "memory.hpp"
#include "simd.hpp"

namespace clear {

inline constexpr int kBin = 32;                             // edge of a bin, px: what a Gaussian is sorted into
inline constexpr int kBlock = 4;                            // edge of a block, px: what sixteen lanes blend
inline constexpr int kBlocksAcross = kBin / kBlock;         // 8
inline constexpr int kBlocks = kBlocksAcross * kBlocksAcross;  // 64: the blocks of a bin are the bits of a word

template <class T>
inline constexpr T kLog2E = T(1.4426950408889634);

// The fields of rasterizers.interface.RasterSettings.
template <class T>
struct Settings {
  T kernel, near, alpha_min, alpha_max, transmittance_min;
  T background[3];
  bool antialiased;
};

template <class T>
struct Pose {
  T R[9], t[3], center[3];
};

// One pixel grid of a pose, and how far off-axis the Jacobian follows (as tangents).
template <class T>
struct Screen {
  T fx, fy, cx, cy;
  int width, height;

  int columns() const { return (width + kBin - 1) / kBin; }
  int rows() const { return (height + kBin - 1) / kBin; }
  static constexpr T kMargin = T(0.3);  // share of the half field of view beyond the image
  T left() const { return -cx / fx - kMargin * T(width) / (2 * fx); }
  T right() const { return (T(width) - cx) / fx + kMargin * T(width) / (2 * fx); }
  T top() const { return -cy / fy - kMargin * T(height) / (2 * fy); }
  T bottom() const { return (T(height) - cy) / fy + kMargin * T(height) / (2 * fy); }
};

template <class T>
bool same_view(const Screen<T>& a, const Screen<T>& b) {
  return a.left() == b.left() && a.right() == b.right() && a.top() == b.top() && a.bottom() == b.bottom();
}

// The tensors of rasterizers.interface.Splats that all screens share.
template <class T>
struct Splats {
  std::int64_t n;
  const T *means, *quats, *scales, *sh0, *shN;
  std::int64_t shN_stride;  // numbers from one Gaussian's shN to the next: inactive bands are stepped over
  int bands;                // 0, 3, 8 or 15
};

// A Gaussian on a screen: alpha = 2^(peak - A dx² - B dx dy - C dy²). Sixteen numbers: one cache line, one register.
template <class T>
struct alignas(kLanes * sizeof(T)) Ellipse {
  T u, v;            // centre, px
  T A, B, C;         // conic times log2(e)/2, log2(e), log2(e)/2
  T peak;            // log2 of the opacity after the Mip compensation
  T reach;           // alpha >= alpha_min within A dx² + B dx dy + C dy² <= reach (a little generous); <= 0: not drawn
  T half_x, half_y;  // half the box around that region, px
  T r, g, b;         // colour, clamped at 0
  T padding[4];
};
static_assert(sizeof(Ellipse<float>) == 64);

// What the blocks send back to a Gaussian: q = ∂L/∂(log alpha) summed over pixels, q's moments about the centre, and ∂L/∂rgb.
template <class T>
struct alignas(kLanes * sizeof(T)) Pulled {
  T q, qx, qy, qxx, qxy, qyy, r, g, b;
  T padding[7];
};

}  // namespace clear
