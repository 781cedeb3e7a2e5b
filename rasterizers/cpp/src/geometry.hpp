// Projects sixteen Gaussians to ellipses on a pixel grid, and its VJP. Arithmetic on lanes only; no tensors.
//
//   Σ' = X-Y block of T Tᵀ + kernel·I,   T = J W R(q) diag(s)   (2 x 3)
//
// Determinants are sums of squared minors of the factor T (Cauchy-Binet), because ac - b² loses all digits for a needle.
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

// The camera's rotation in the precision of T.
template <class T>
struct Rotation {
  T R[9];
  explicit Rotation(const Pose& pose) {
    for (int i = 0; i < 9; ++i) R[i] = T(pose.R[i]);
  }
  T operator[](int i) const { return R[i]; }
};

// The centre in camera coordinates, always in double: in float, an image coordinate of 1,000 px is off by 1e-4 px, which
// shifts thin needles, and close depths may compare equal and be drawn in the wrong order.
struct Centre {
  using D = Lanes<double>;
  D x, y, z, tan_x, tan_y;

  template <class T>
  CLEAR_INLINE Centre(const Pose& pose, const Vec3<T>& mean) {
    const D m[3] = {convert<double>(mean[0]), convert<double>(mean[1]), convert<double>(mean[2])};
    const double* W = pose.R;
    x = D(W[0]) * m[0] + D(W[1]) * m[1] + D(W[2]) * m[2] + D(pose.t[0]);
    y = D(W[3]) * m[0] + D(W[4]) * m[1] + D(W[5]) * m[2] + D(pose.t[1]);
    z = D(W[6]) * m[0] + D(W[7]) * m[1] + D(W[8]) * m[2] + D(pose.t[2]);
    const D inverse = D(1.0) / z;
    tan_x = x * inverse, tan_y = y * inverse;
  }
};

// Everything that does not depend on the focal length; shared by the grids of a pose.
template <class T>
struct Geometry {
  using L = Lanes<T>;
  L x, y, z, inverse_z;  // camera coordinates
  L tan_x, tan_y;        // x/z, y/z …
  L lim_x, lim_y;        // … and clamped far outside the image, where the affine approximation explodes
  L unit[4], inverse_norm;  // q / |q|
  L R[9];                // the Gaussian's rotation
  L axes[9];             // W R diag(s)
  L row_x[3], row_y[3];  // T for focal length 1

  CLEAR_INLINE Geometry(const Pose& pose, const Grid<T>& grid, const Centre& centre, const L (&quat)[4],
                        const Vec3<T>& scale) {
    const Rotation<T> W(pose);
    x = convert<T>(centre.x), y = convert<T>(centre.y), z = convert<T>(centre.z);
    inverse_z = L(T(1)) / z;
    tan_x = convert<T>(centre.tan_x), tan_y = convert<T>(centre.tan_y);

    rotation(quat);
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k)
        axes[3 * i + k] = (W[3 * i] * R[k] + W[3 * i + 1] * R[3 + k] + W[3 * i + 2] * R[6 + k]) * scale[k];
    place(grid);
  }

  // What depends on the tangents at which this grid clamps.
  CLEAR_INLINE void place(const Grid<T>& grid) {
    lim_x = clamp(tan_x, L(grid.left), L(grid.right));
    lim_y = clamp(tan_y, L(grid.top), L(grid.bottom));
    for (int k = 0; k < 3; ++k) {
      row_x[k] = (axes[k] - lim_x * axes[6 + k]) * inverse_z;
      row_y[k] = (axes[3 + k] - lim_y * axes[6 + k]) * inverse_z;
    }
  }

 private:
  // Divides by the largest component first, so that |q|² neither overflows nor underflows. The zero quaternion is the
  // identity.
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
};

// The ellipse on a pixel grid. Lengths are in units of `size`, the larger of T's largest entry and √kernel, so that
// fourth powers neither overflow nor underflow.
template <class T>
struct Footprint {
  using L = Lanes<T>;
  L X[3], Y[3];          // the rows of T
  L size, kernel;        // kernel / size²
  L a, b, c;             // T Tᵀ / size²
  L normal[3], area;     // X x Y / size² and its length, √det(T Tᵀ) / size²
  L det;                 // det Σ' / size⁴
  L A, S, D;             // dᵀ Σ'⁻¹ d = A (dx + S dy)² + D dy²: a sum of squares, without cancellation
  L compensation;        // Mip-Splatting: √(det T Tᵀ / det Σ'), opacity factor that makes up for the kernel's blur

  CLEAR_INLINE Footprint(const Geometry<T>& g, const Grid<T>& grid, const Settings<T>& s) {
    L largest = s.root_kernel;
    for (int k = 0; k < 3; ++k) {
      X[k] = L(grid.fx) * g.row_x[k];
      Y[k] = L(grid.fy) * g.row_y[k];
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
    const L blurred = c + kernel, inverse = shrink * shrink / blurred;
    A = shrink * shrink * blurred / det, S = -b / blurred, D = inverse;
    compensation = s.antialiased ? area / root(det) : L(T(1));
  }
};

// Gradients of one Gaussian's tensors, sixteen at a time.
template <class T>
struct LaneGradients {
  using L = Lanes<T>;
  L mean[3], quat[4], scale[3], opacity;
};

// The gradient of the projected centre, Σ'⁻¹ Σ q d, from the moments of q that the blocks add up.
template <class T>
CLEAR_INLINE void screen_vjp(const Footprint<T>& f, const Lanes<T>& qu, const Lanes<T>& qy, Lanes<T> (&out)[2]) {
  out[0] = f.A * qu;
  out[1] = f.S * out[0] + f.D * qy;
}

// VJP of the projection: ∂L/∂T = Σ'⁻¹ (Σ q d dᵀ) Σ'⁻¹ T + q ∂ log ρ/∂T, ρ the compensation.
template <class T>
CLEAR_INLINE void project_vjp(const Pose& pose, const Grid<T>& grid, const Settings<T>& s, const Geometry<T>& g,
                              const Footprint<T>& f, const Vec3<T>& scale, const Lanes<T>& opacity, const Lanes<T>& q,
                              const Lanes<T>& qu, const Lanes<T>& qy, const Lanes<T>& quu, const Lanes<T>& quy,
                              const Lanes<T>& qyy, LaneGradients<T>& out) {
  using L = Lanes<T>;
  const Rotation<T> W(pose);
  out.opacity = q / opacity;
  L screen[2];
  screen_vjp(f, qu, qy, screen);
  const L du = screen[0], dv = screen[1];

  // ∂L/∂T. In the coordinates (u, dy) of Footprint, Σ'⁻¹ is the diagonal (A, D), and the rows of T are X + S Y and Y. The first
  // times A is P = (y x n + κ x)/det with the rows x and y of T: sums without cancellation, where those of X + S Y lose all digits
  // for a needle.
  L tx[3], ty[3], along_x[3], along_y[3], dX[3], dY[3];
  const L shrink = L(T(1)) / f.size, over_det = shrink / f.det;
  for (int k = 0; k < 3; ++k) tx[k] = f.X[k] * shrink, ty[k] = f.Y[k] * shrink;
  cross<T>(ty, f.normal, along_x);
  for (int k = 0; k < 3; ++k) {
    const L pu = (along_x[k] + f.kernel * tx[k]) * over_det, py = f.D * f.Y[k];
    dX[k] = f.A * (quu * pu + quy * py);
    dY[k] = f.S * dX[k] + f.D * (quy * pu + qyy * py);
  }
  if (s.antialiased) {
    // log ρ = ½ log area² - ½ log(area² + κ tr + κ²). This form avoids the cancellation for large Gaussians:
    //   ∂ log ρ/∂x = κ/det ((tr + κ)/area² (y x n) - x),   and for y with n x x.
    cross<T>(f.normal, tx, along_y);
    L weight = q * f.kernel * over_det, turn = (f.a + f.c + f.kernel) / (f.area * f.area);
    for (int k = 0; k < 3; ++k) {
      dX[k] += weight * (turn * along_x[k] - tx[k]);
      dY[k] += weight * (turn * along_y[k] - ty[k]);
    }
  }

  // T = J axes: gradients of the axes, of 1/z, and of the tangents where they are not clamped.
  L dA[9], slope_x = T(0), slope_y = T(0), over_z = T(0);
  for (int k = 0; k < 3; ++k) {
    L gx = L(grid.fx) * dX[k] * g.inverse_z, gy = L(grid.fy) * dY[k] * g.inverse_z;
    dA[k] = gx;
    dA[3 + k] = gy;
    dA[6 + k] = -(g.lim_x * gx + g.lim_y * gy);
    slope_x -= g.axes[6 + k] * gx;
    slope_y -= g.axes[6 + k] * gy;
    over_z += f.X[k] * dX[k] + f.Y[k] * dY[k];
  }
  L dtx = L(grid.fx) * du + where((g.tan_x >= L(grid.left)) & (g.tan_x <= L(grid.right)), slope_x);
  L dty = L(grid.fy) * dv + where((g.tan_y >= L(grid.top)) & (g.tan_y <= L(grid.bottom)), slope_y);
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
