// Spatial (6-D) vectors and rotations.
//
// A motion vector is (angular, linear); the linear part is the velocity at the origin of the frame in which the vector is
// expressed: a point x has the velocity linear + angular × x. A force vector is (moment about the origin, force). Their
// dot product is power.
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "math/dual.hpp"

// For small functions of inner loops, which the compiler would not inline on its own.
#define GELFLOW_INLINE __attribute__((always_inline)) inline
#define GELFLOW_LOOP_BODY __attribute__((always_inline))

namespace gelflow {

template <class T>
using V3 = Eigen::Matrix<T, 3, 1>;
template <class T>
using M3 = Eigen::Matrix<T, 3, 3>;
template <class T>
using V4 = Eigen::Matrix<T, 4, 1>;
template <class T>
using V6 = Eigen::Matrix<T, 6, 1>;
template <class T>
using M6 = Eigen::Matrix<T, 6, 6>;
template <class T>
using VX = Eigen::Matrix<T, Eigen::Dynamic, 1>;
template <class T>
using MX = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;

// The scalar type of positions in the world: double in single precision too, where differences of positions would be
// lost to rounding (`Batch<float>`).
template <class T>
struct PositionScalarOf {
  using type = T;
};
template <>
struct PositionScalarOf<float> {
  using type = double;
};
template <class T>
using PositionScalar = typename PositionScalarOf<T>::type;

// The matrix cast to scalars of type T; no copy if they are already.
template <class T, class Matrix>
GELFLOW_INLINE decltype(auto) as(const Matrix& x) {
  if constexpr (std::is_same_v<T, typename Matrix::Scalar>) {
    return (x);
  } else {
    return Eigen::Matrix<T, Matrix::RowsAtCompileTime, Matrix::ColsAtCompileTime>(x.template cast<T>());
  }
}

template <class T>
GELFLOW_INLINE V3<T> cross(const V3<T>& a, const V3<T>& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// [a]× with [a]× b = a × b.
template <class T>
GELFLOW_INLINE M3<T> skew(const V3<T>& a) {
  M3<T> m;
  m << T(0), -a[2], a[1], a[2], T(0), -a[0], -a[1], a[0], T(0);
  return m;
}

// [x]× A without products by zero.
template <class T>
GELFLOW_INLINE M3<T> cross_columns(const V3<T>& x, const M3<T>& a) {
  M3<T> r;
  for (int j = 0; j < 3; ++j) {
    r(0, j) = x[1] * a(2, j) - x[2] * a(1, j);
    r(1, j) = x[2] * a(0, j) - x[0] * a(2, j);
    r(2, j) = x[0] * a(1, j) - x[1] * a(0, j);
  }
  return r;
}

template <class T>
GELFLOW_INLINE V3<T> top(const V6<T>& x) {
  return x.template head<3>();
}
template <class T>
GELFLOW_INLINE V3<T> bottom(const V6<T>& x) {
  return x.template tail<3>();
}
template <class T>
GELFLOW_INLINE V6<T> stack(const V3<T>& a, const V3<T>& b) {
  V6<T> x;
  for (int i = 0; i < 3; ++i) {
    x[i] = a[i];
    x[i + 3] = b[i];
  }
  return x;
}
template <class T>
GELFLOW_INLINE T dot6(const V6<T>& a, const V6<T>& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5];
}

// Motion × motion: the rate of change of y, fixed in a frame that moves with x.
template <class T>
GELFLOW_INLINE V6<T> cross_motion(const V6<T>& x, const V6<T>& y) {
  const V3<T> w = top(x), v = bottom(x), yw = top(y), yv = bottom(y);
  return stack<T>(cross(w, yw), cross(w, yv) + cross(v, yw));
}

// Motion ×* force: the rate of change of f, fixed in a frame that moves with x.
template <class T>
GELFLOW_INLINE V6<T> cross_force(const V6<T>& x, const V6<T>& f) {
  const V3<T> w = top(x), v = bottom(x), n = top(f), l = bottom(f);
  return stack<T>(cross(w, n) + cross(v, l), cross(w, l));
}

template <class T>
GELFLOW_INLINE M3<T> rotation_of(const V4<T>& q) {  // unit quaternion w x y z
  const T w = q[0], x = q[1], y = q[2], z = q[3];
  M3<T> r;
  r << T(1) - T(2) * (y * y + z * z), T(2) * (x * y - w * z), T(2) * (x * z + w * y),  //
      T(2) * (x * y + w * z), T(1) - T(2) * (x * x + z * z), T(2) * (y * z - w * x),   //
      T(2) * (x * z - w * y), T(2) * (y * z + w * x), T(1) - T(2) * (x * x + y * y);
  return r;
}

template <class T>
V4<T> quaternion_product(const V4<T>& p, const V4<T>& q) {
  return {p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3], p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
          p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1], p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0]};
}

// sin(θ/2)/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³ and cos(θ/2) as functions of θ², which are smooth at θ = 0.
template <class T>
struct RotationSeries {
  T half_sinc, one_minus_cos, theta_minus_sin, half_cos;
  explicit RotationSeries(const T& squared) {
    using std::cos;
    using std::sin;
    using std::sqrt;
    if (real_part(squared) < 1e-4) {  // power series; the next terms are below 1e-19
      const T s = squared;
      const auto over = [&](double divisor) { return T(s * T(1 / divisor)); };
      half_sinc = T(0.5) - over(48) * (T(1) - over(80) * (T(1) - over(168)));
      half_cos = T(1) - over(8) * (T(1) - over(48) * (T(1) - over(120)));
      one_minus_cos = T(0.5) - over(24) * (T(1) - over(30) * (T(1) - over(56)));
      theta_minus_sin = T(1.0 / 6) - over(120) * (T(1) - over(42) * (T(1) - over(72)));
    } else {
      const T theta = sqrt(squared);
      half_sinc = sin(theta * T(0.5)) / theta;
      half_cos = cos(theta * T(0.5));
      one_minus_cos = (T(1) - cos(theta)) / squared;
      theta_minus_sin = (theta - sin(theta)) / (squared * theta);
    }
  }
};

// Unit quaternion of a rotation vector (exponential map).
template <class T>
V4<T> quaternion_exp(const V3<T>& phi) {
  const RotationSeries<T> s(phi.squaredNorm());
  return {s.half_cos, s.half_sinc * phi[0], s.half_sinc * phi[1], s.half_sinc * phi[2]};
}

// Right Jacobian: exp(φ + δ) = exp(φ) exp(Jr(φ) δ) to first order.
template <class T>
M3<T> right_jacobian(const V3<T>& phi) {
  const RotationSeries<T> s(phi.squaredNorm());
  const M3<T> k = skew<T>(phi);
  return M3<T>::Identity() - s.one_minus_cos * k + s.theta_minus_sin * (k * k);
}

// Rotation by `angle` about the unit vector a (Rodrigues): cos + (1 − cos) a aᵀ + sin [a]×.
template <class T>
M3<T> axis_rotation(const V3<T>& axis, const T& angle) {
  using std::cos;
  using std::sin;
  const T c = cos(angle), s = sin(angle);
  const V3<T> rest = (T(1) - c) * axis;
  M3<T> r;
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    r(i, i) = c + rest[i] * axis[i];
    r(i, j) = rest[i] * axis[j] - s * axis[k];
    r(i, k) = rest[i] * axis[k] + s * axis[j];
  }
  return r;
}

}  // namespace gelflow
