// Project: sixteen Gaussians to ellipses on a screen, and the way back. Mathematics on lanes; touches no memory.
//
//   Σ' = X-Y block of T Tᵀ + kernel·I,   T = J W R(q) diag(s)   (2 x 3)
//
// Determinants come from the factor T as sums of squared minors (Cauchy-Binet): ac - b² loses every digit of a needle.
#pragma once

#include "types.hpp"

namespace clear {

template <class T>
using Vec3 = Lanes<T>[3];

template <class T>
CLEAR_INLINE Lanes<T> dot(const Vec3<T>& a, const Vec3<T>& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
template <class T>
CLEAR_INLINE void cross(const Vec3<T>& a, const Vec3<T>& b, Vec3<T>& out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

// Everything that does not depend on the focal length, so that all screens of a pose share it.
template <class T>
struct Geometry {
  using L = Lanes<T>;
  L x, y, z, inverse_z;  // camera coordinates
  L tan_x, tan_y;        // x/z, y/z …
  L lim_x, lim_y;        // … and clamped far outside the image, where the affine approximation explodes
  L unit[4], inverse_norm;  // q / |q|
  L R[9];                // of the Gaussian
  L axes[9];             // W R diag(s)
  L row_x[3], row_y[3];  // T for focal length 1

  CLEAR_INLINE Geometry(const Pose<T>& pose, const Screen<T>& screen, const Vec3<T>& mean, const L (&quat)[4],
                        const Vec3<T>& scale) {
    const T* W = pose.R;
    x = W[0] * mean[0] + W[1] * mean[1] + W[2] * mean[2] + L(pose.t[0]);
    y = W[3] * mean[0] + W[4] * mean[1] + W[5] * mean[2] + L(pose.t[1]);
    z = W[6] * mean[0] + W[7] * mean[1] + W[8] * mean[2] + L(pose.t[2]);
    inverse_z = L(T(1)) / z;
    tan_x = x * inverse_z;
    tan_y = y * inverse_z;
    lim_x = clamp(tan_x, L(screen.left()), L(screen.right()));
    lim_y = clamp(tan_y, L(screen.top()), L(screen.bottom()));

    rotation(quat);
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k)
        axes[3 * i + k] = (W[3 * i] * R[k] + W[3 * i + 1] * R[3 + k] + W[3 * i + 2] * R[6 + k]) * scale[k];
    for (int k = 0; k < 3; ++k) {
      row_x[k] = (axes[k] - lim_x * axes[6 + k]) * inverse_z;
      row_y[k] = (axes[3 + k] - lim_y * axes[6 + k]) * inverse_z;
    }
  }

 private:
  // Scaled by the largest component first: |q|² neither overflows nor underflows. The zero quaternion is the identity.
  CLEAR_INLINE void rotation(const L (&quat)[4]) {
    L largest = maximum(maximum(absolute(quat[0]), absolute(quat[1])), maximum(absolute(quat[2]), absolute(quat[3])));
    Mask<T> zero = largest <= L(T(0));
    L shrink = L(T(1)) / select(zero, L(T(1)), largest);
    L q[4] = {select(zero, L(T(1)), quat[0] * shrink), quat[1] * shrink, quat[2] * shrink, quat[3] * shrink};
    L inverse = L(T(1)) / root(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; ++i) unit[i] = q[i] * inverse;
    inverse_norm = select(zero, L(T(0)), inverse * shrink);
    L w = unit[0], x_ = unit[1], y_ = unit[2], z_ = unit[3], two = T(2), one = T(1);
    R[0] = one - two * (y_ * y_ + z_ * z_), R[1] = two * (x_ * y_ - w * z_), R[2] = two * (x_ * z_ + w * y_);
    R[3] = two * (x_ * y_ + w * z_), R[4] = one - two * (x_ * x_ + z_ * z_), R[5] = two * (y_ * z_ - w * x_);
    R[6] = two * (x_ * z_ - w * y_), R[7] = two * (y_ * z_ + w * x_), R[8] = one - two * (x_ * x_ + y_ * y_);
  }
  friend CLEAR_INLINE L operator*(T a, const L& b) { return L(a) * b; }
};

// The ellipse of a screen. Lengths are measured in `size`, the larger of T's largest entry and √kernel: whatever the
// Gaussian, the numbers that are squared twice lie between 0 and a few.
template <class T>
struct Footprint {
  using L = Lanes<T>;
  L X[3], Y[3];          // the rows of T
  L size, kernel;        // kernel / size²
  L a, b, c;             // T Tᵀ / size²
  L normal[3], area;     // X x Y / size² and its length, √det(T Tᵀ) / size²
  L det;                 // det Σ' / size⁴
  L xx, xy, yy;          // Σ'⁻¹
  L compensation;        // Mip-Splatting: √(det T Tᵀ / det Σ'), so that the kernel keeps a splat's total

  CLEAR_INLINE Footprint(const Geometry<T>& g, const Screen<T>& screen, const Settings<T>& s) {
    L largest = root(L(s.kernel));
    for (int k = 0; k < 3; ++k) {
      X[k] = L(screen.fx) * g.row_x[k];
      Y[k] = L(screen.fy) * g.row_y[k];
      largest = maximum(largest, maximum(absolute(X[k]), absolute(Y[k])));
    }
    size = largest;
    L shrink = L(T(1)) / size;
    L x[3], y[3];
    for (int k = 0; k < 3; ++k) x[k] = X[k] * shrink, y[k] = Y[k] * shrink;
    kernel = L(s.kernel) * shrink * shrink;
    a = dot<T>(x, x), b = dot<T>(x, y), c = dot<T>(y, y);
    cross<T>(x, y, normal);
    L area2 = dot<T>(normal, normal);
    area = root(area2);
    det = area2 + kernel * (a + c) + kernel * kernel;
    L inverse = shrink * shrink / det;
    xx = (c + kernel) * inverse, xy = -b * inverse, yy = (a + kernel) * inverse;
    compensation = s.antialiased ? area / root(det) : L(T(1));
  }
};

// Gradients of one Gaussian's tensors, sixteen at a time.
template <class T>
struct Pull {
  using L = Lanes<T>;
  L mean[3], quat[4], scale[3], opacity, screen[2];
};

// Back through the projection. q and its moments come from the blocks; M = [[qxx, qxy], [qxy, qyy]]:
//   ∂L/∂u = Σ'⁻¹ (qx, qy)      ∂L/∂T = Σ'⁻¹ M Σ'⁻¹ T  (+ the compensation's q · (∂ log area - Σ'⁻¹ T))
template <class T>
CLEAR_INLINE void project_vjp(const Pose<T>& pose, const Screen<T>& screen, const Settings<T>& s, const Geometry<T>& g,
                              const Footprint<T>& f, const Vec3<T>& scale, const Lanes<T>& opacity, const Lanes<T>& q,
                              const Lanes<T>& qx, const Lanes<T>& qy, const Lanes<T>& qxx, const Lanes<T>& qxy,
                              const Lanes<T>& qyy, Pull<T>& out) {
  using L = Lanes<T>;
  const T* W = pose.R;
  out.opacity = q / opacity;
  L du = out.screen[0] = f.xx * qx + f.xy * qy;
  L dv = out.screen[1] = f.xy * qx + f.yy * qy;

  // ∂L/∂T
  L dX[3], dY[3];
  for (int k = 0; k < 3; ++k) {
    L px = f.xx * f.X[k] + f.xy * f.Y[k], py = f.xy * f.X[k] + f.yy * f.Y[k];  // P = Σ'⁻¹ T
    L mx = qxx * px + qxy * py, my = qxy * px + qyy * py;                      // M P
    dX[k] = f.xx * mx + f.xy * my;
    dY[k] = f.xy * mx + f.yy * my;
    if (s.antialiased) dX[k] -= q * px, dY[k] -= q * py;
  }
  if (s.antialiased) {
    // log area pulls along the rows' in-plane normals: (Y x n)/|n|², (n x X)/|n|², in the units of `size`.
    L x[3], y[3], along_x[3], along_y[3], shrink = L(T(1)) / f.size;
    for (int k = 0; k < 3; ++k) x[k] = f.X[k] * shrink, y[k] = f.Y[k] * shrink;
    cross<T>(y, f.normal, along_x);
    cross<T>(f.normal, x, along_y);
    L weight = q * shrink / (f.area * f.area);
    for (int k = 0; k < 3; ++k) dX[k] += weight * along_x[k], dY[k] += weight * along_y[k];
  }

  // T = J axes: to the axes, to 1/z, and to the tangents where they are not clamped.
  L dA[9], slope_x = T(0), slope_y = T(0), over_z = T(0);
  for (int k = 0; k < 3; ++k) {
    L gx = L(screen.fx) * dX[k] * g.inverse_z, gy = L(screen.fy) * dY[k] * g.inverse_z;
    dA[k] = gx;
    dA[3 + k] = gy;
    dA[6 + k] = -(g.lim_x * gx + g.lim_y * gy);
    slope_x -= g.axes[6 + k] * gx;
    slope_y -= g.axes[6 + k] * gy;
    over_z += f.X[k] * dX[k] + f.Y[k] * dY[k];
  }
  L dtx = L(screen.fx) * du + where((g.tan_x >= L(screen.left())) & (g.tan_x <= L(screen.right())), slope_x);
  L dty = L(screen.fy) * dv + where((g.tan_y >= L(screen.top())) & (g.tan_y <= L(screen.bottom())), slope_y);
  L dx = dtx * g.inverse_z, dy = dty * g.inverse_z;
  L dz = -(dtx * g.tan_x + dty * g.tan_y + over_z) * g.inverse_z;
  for (int k = 0; k < 3; ++k) out.mean[k] = L(W[k]) * dx + L(W[3 + k]) * dy + L(W[6 + k]) * dz;

  // axes = W R diag(s)
  L dR[9];
  for (int k = 0; k < 3; ++k) {
    L along = T(0);
    for (int i = 0; i < 3; ++i) {
      L back = L(W[i]) * dA[k] + L(W[3 + i]) * dA[3 + k] + L(W[6 + i]) * dA[6 + k];
      along += g.R[3 * i + k] * back;
      dR[3 * i + k] = back * scale[k];
    }
    out.scale[k] = along;
  }
  L w = g.unit[0], x = g.unit[1], y = g.unit[2], z = g.unit[3], two = T(2);
  L d[4];
  d[0] = two * (x * (dR[7] - dR[5]) + y * (dR[2] - dR[6]) + z * (dR[3] - dR[1]));
  d[1] = two * (y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) + w * (dR[7] - dR[5]) - two * x * (dR[4] + dR[8]));
  d[2] = two * (x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) + w * (dR[2] - dR[6]) - two * y * (dR[0] + dR[8]));
  d[3] = two * (x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) + w * (dR[3] - dR[1]) - two * z * (dR[0] + dR[4]));
  L radial = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
  for (int i = 0; i < 4; ++i) out.quat[i] = (d[i] - radial * g.unit[i]) * g.inverse_norm;
}

}  // namespace clear
