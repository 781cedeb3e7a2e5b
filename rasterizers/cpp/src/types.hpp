// The data types shared by the stages. `T` is float, or double for checking.
#pragma once

#include <cstdint>
#include <vector>

#include "memory.hpp"
#include "simd.hpp"

namespace clear {

// Calls visit(i) for each bit i that is set, ascending.
template <class Visit>
CLEAR_INLINE void each_bit(std::uint64_t bits, Visit&& visit) {
  for (; bits; bits &= bits - 1) visit(__builtin_ctzll(bits));
}

inline constexpr int kBin = 32;                             // edge of a bin, px: Gaussians are listed by bin
inline constexpr int kBlock = 4;                            // edge of a block, px: sixteen lanes blend one
inline constexpr int kBlocksAcross = kBin / kBlock;         // 8
inline constexpr int kBlocks = kBlocksAcross * kBlocksAcross;  // 64: a 64-bit word has a bit per block of a bin

template <class T>
inline constexpr T kLog2E = T(1.4426950408889634);

// The fields of rasterizers.interface.RasterSettings.
template <class T>
struct Settings {
  T kernel, near, alpha_min, alpha_max, transmittance_min;
  T background[3];
  bool antialiased;
  // Computed here, not for every sixteen Gaussians.
  T log2_alpha_min = std::log2(alpha_min), root_kernel = std::sqrt(kernel);
};

// In double, because centres are always computed in double; see `Centre`.
struct Pose {
  double R[9], t[3], center[3];
};

// One pixel grid of a pose, and the tangents at which the Jacobian is clamped. These are computed in double, so that scaled
// copies of a camera have the same ones.
template <class T>
struct Grid {
  T fx, fy, cx, cy;
  int width, height;
  T left, right, top, bottom;

  Grid() = default;
  Grid(double fx, double fy, double cx, double cy, int width, int height)
      : fx(T(fx)), fy(T(fy)), cx(T(cx)), cy(T(cy)), width(width), height(height),
        left(T(-cx / fx - kMargin * width / (2 * fx))), right(T((width - cx) / fx + kMargin * width / (2 * fx))),
        top(T(-cy / fy - kMargin * height / (2 * fy))), bottom(T((height - cy) / fy + kMargin * height / (2 * fy))) {}

  int columns() const { return (width + kBin - 1) / kBin; }
  int rows() const { return (height + kBin - 1) / kBin; }
  bool same_view(const Grid& o) const { return left == o.left && right == o.right && top == o.top && bottom == o.bottom; }
  static constexpr double kMargin = 0.3;  // share of the half field of view beyond the image
};

// The tensors of rasterizers.interface.Splats that are shared by all grids.
template <class T>
struct Splats {
  std::int64_t n;
  const T *means, *quats, *scales, *sh0, *shN;
  std::int64_t shN_stride;  // distance between the shN rows of two Gaussians: inactive bands are skipped
  int bands;                // 0, 3, 8 or 15
};

// A projected Gaussian: alpha = 2^(peak - A u² - D dy²) with u = dx + S dy. Sixteen numbers: one cache line, one register.
// A conic's expanded form, A dx² + B dx dy + C dy², would lose all digits far along a thin Gaussian, where its terms cancel.
template <class T>
struct alignas(kLanes * sizeof(T)) Ellipse {
  T u, v;            // centre, px, minus (whole_u, whole_v)
  T A, S, D;         // of Footprint; A and D times log2(e)/2
  T peak;            // log2 of the opacity after the Mip compensation
  T reach;           // alpha >= alpha_min within A u² + D dy² <= reach (with a margin); <= 0: not drawn
  T half_x, half_y;  // half the box around that region, px
  T r, g, b, z;      // colour, clamped at 0, and the centre's depth: the channels that are blended
  T whole_u, whole_v;  // the whole pixel nearest to the centre: at 1,000 px a float resolves 6e-5 px
  T padding;
};
static_assert(sizeof(Ellipse<float>) == 64);

// Indices of an Ellipse's fields among its sixteen numbers.
enum Field { kU, kV, kA, kS, kD, kPeak, kReach, kHalfX, kHalfY, kRed, kGreen, kBlue, kDepth, kWholeU, kWholeV };

inline constexpr int kColour = 3, kColourAndDepth = 4;  // channels that are blended

// The gradients of K images [K, height, width, 3], and of their alpha and accumulated depth Σ T_i α_i z_i [K, height, width], which
// may be null.
template <class T>
struct Cotangents {
  const T *image, *alpha, *depth;
};

// Sums over the pixels of a (Gaussian, bin) pair, for each of K cotangents: q = ∂L/∂(log alpha), q's moments about the centre
// u, y, uu, uy, yy with the u of Ellipse, and ∂L/∂(r, g, b); with absolute gradients also Σ|∂L/∂u|; with depth, last, ∂L/∂z.
// Packed, because they are written, read and transposed by sixteen.
template <class T, int K, int C = kColour, bool Absolute = false>
struct alignas(kLanes * sizeof(T)) PairSums {
  static constexpr int kWidth = 6 + C + (Absolute ? 2 : 0), kRows = (K * kWidth + kLanes - 1) / kLanes;
  T numbers[kRows * kLanes];

  static constexpr int of_channel(int c) { return c < kColour ? 6 + c : kWidth - 1; }
};

}  // namespace clear
