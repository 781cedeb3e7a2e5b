// Colour from spherical harmonics for sixteen directions, with its derivative along the position (`slope`).
//
// The direction does not depend on the resolution, so colour and slope are computed once for all pixel grids. The slope
// (nine numbers) is kept, so the backward pass does not read the coefficients again.
#pragma once

#include "geometry.hpp"

namespace clear {

// A derivative that is 0 for every direction.
struct Zero {};

template <class T>
CLEAR_INLINE void add_product(Lanes<T>& sum, const Lanes<T>& a, const Lanes<T>& b) {
  sum += a * b;
}
template <class T>
CLEAR_INLINE void add_product(Lanes<T>&, Zero, const Lanes<T>&) {}

// Y and its derivatives with respect to the unit direction, band by band, with the signs of 3DGS.
// Calls band(k, Y, dx, dy, dz) for k = 0 … bands.
template <class T, class Band>
CLEAR_INLINE void each_band(int bands, const Vec3<T>& direction, Band&& band) {
  using L = Lanes<T>;
  const L x = direction[0], y = direction[1], z = direction[2];
  const Zero none;
  band(0, L(T(0.28209479177387814)), none, none, none);
  if (bands < 3) return;
  const L c1 = T(0.4886025119029199);
  band(1, -c1 * y, none, -c1, none);
  band(2, c1 * z, none, none, c1);
  band(3, -c1 * x, -c1, none, none);
  if (bands < 8) return;
  const L xx = x * x, yy = y * y, zz = z * z, two = T(2), three = T(3), four = T(4), six = T(6), eight = T(8);
  const L a = T(1.0925484305920792), b = T(0.31539156525252005), c = T(0.5462742152960396);
  band(4, a * x * y, a * y, a * x, none);
  band(5, -a * y * z, none, -a * z, -a * y);
  band(6, b * (two * zz - xx - yy), -two * b * x, -two * b * y, four * b * z);
  band(7, -a * x * z, -a * z, none, -a * x);
  band(8, c * (xx - yy), two * c * x, -two * c * y, none);
  if (bands < 15) return;
  const L d = T(-0.5900435899266435), e = T(2.890611442640554), f = T(-0.4570457994644658), h = T(0.3731763325901154);
  const L i = T(1.445305721320277);
  band(9, d * y * (three * xx - yy), six * d * x * y, three * d * (xx - yy), none);
  band(10, e * x * y * z, e * y * z, e * x * z, e * x * y);
  band(11, f * y * (four * zz - xx - yy), -two * f * x * y, f * (four * zz - xx - three * yy), eight * f * y * z);
  band(12, h * z * (two * zz - three * xx - three * yy), -six * h * x * z, -six * h * y * z,
       three * h * (two * zz - xx - yy));
  band(13, f * x * (four * zz - xx - yy), f * (four * zz - three * xx - yy), -two * f * x * y, eight * f * x * z);
  band(14, i * z * (xx - yy), two * i * x * z, -two * i * y * z, i * (xx - yy));
  band(15, d * x * (xx - three * yy), three * d * (xx - yy), -six * d * x * y, none);
}

template <class T>
CLEAR_INLINE void direction_of(const Pose& pose, const Vec3<T>& mean, Vec3<T>& direction, Lanes<T>& inverse_length) {
  for (int k = 0; k < 3; ++k) direction[k] = mean[k] - Lanes<T>(T(pose.center[k]));
  inverse_length = Lanes<T>(T(1)) / root(dot<T>(direction, direction));
  for (int k = 0; k < 3; ++k) direction[k] *= inverse_length;
}

// Sixteen colours, before offset and clamp, and ∂rgb/∂mean.
template <class T>
struct Colour {
  Lanes<T> rgb[3], slope[9];
};

// coefficients[3k + c]: band k of channel c, as lanes.
template <class T>
CLEAR_INLINE void colour_of(const Pose& pose, const Vec3<T>& mean, int bands, const Lanes<T>* coefficients,
                            Colour<T>& out) {
  using L = Lanes<T>;
  Vec3<T> direction;
  L inverse_length;
  direction_of(pose, mean, direction, inverse_length);
  for (L& c : out.rgb) c = T(0.5);
  for (L& d : out.slope) d = T(0);
  each_band<T>(bands, direction, [&](int k, const L& Y, const auto& dx, const auto& dy, const auto& dz) CLEAR_LAMBDA {
    for (int c = 0; c < 3; ++c) {
      const L& w = coefficients[3 * k + c];
      out.rgb[c] += Y * w;
      add_product(out.slope[3 * c], dx, w);
      add_product(out.slope[3 * c + 1], dy, w);
      add_product(out.slope[3 * c + 2], dz, w);
    }
  });
  for (int c = 0; c < 3; ++c) {  // derivative of the unit direction: (I - d dᵀ) / length
    L* slope = out.slope + 3 * c;
    L radial = slope[0] * direction[0] + slope[1] * direction[1] + slope[2] * direction[2];
    for (int k = 0; k < 3; ++k) slope[k] = (slope[k] - radial * direction[k]) * inverse_length;
  }
}

}  // namespace clear
