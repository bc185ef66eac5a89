// Signed distance to an ellipsoid.
//
// The nearest point y of the ellipsoid satisfies x − y = t g with g = y/a²: y = a² x/(a² + t), d = t ‖g‖, n = g/‖g‖. At
// the centre, where both ends of the shortest axis are nearest, the positive one is chosen.
#pragma once

#include "geometry/distance.hpp"

namespace gelflow {

// One Newton step for t in Σ (a x/(a² + t))² = 1. Iterations that start left of the root never step over it.
template <class P>
GELFLOW_INLINE P ellipsoid_step(const Vec3<P>& scaled, const Vec3<P>& square, const P& t) {
  const P zero(0.0), one(1.0);
  P value = -one, slope = zero;
  for (int a = 0; a < 3; ++a) {
    const P divisor = square[a] + t;
    const Mask<P> regular = divisor > P(1e-12) * square[a];
    const P ratio = select(regular, scaled[a] / select(regular, divisor, one), zero);
    value += ratio * ratio;
    slope -= P(2.0) * ratio * ratio / select(regular, divisor, one);
  }
  const Mask<P> valid = slope < P(-1e-30) && value > zero;
  return select(valid, -value / select(valid, slope, one), zero);
}

// Hessian: the curvature of the surface S = P diag(1/a²) P/‖g‖ with P = 1 − n nᵀ, and of the parallel surface
// (1 + d S)⁻¹ S. `inverse`: 1/‖g‖.
template <class P>
GELFLOW_INLINE void ellipsoid_hessian(const Vec3<P>& square, const P& inverse, Distance<P>& out) {
  const P one(1.0);
  const Mat3<P> project = identity_minus_outer(out.n);
  Mat3<P> surface = zero33<P>();
  for (int a = 0; a < 3; ++a) surface += inverse / square[a] * outer(project.row[a], project.row[a]);
  Mat3<P> moved = out.d * surface;
  for (int a = 0; a < 3; ++a) moved.row[a][a] += one;
  const Mat3<P> cofactors{cross(moved.row[1], moved.row[2]), cross(moved.row[2], moved.row[0]),
                          cross(moved.row[0], moved.row[1])};
  const P determinant = dot(moved.row[0], cofactors.row[0]);
  const Mask<P> regular = determinant > P(1e-6);  // false at the centre of curvature
  const P scale = select(regular, one / select(regular, determinant, one), one);
  for (int a = 0; a < 3; ++a) {  // the cofactor matrix is symmetric here, so it is the adjugate
    const Vec3<P> row = transposed_times(surface, cofactors.row[a]);
    out.hessian.row[a] = select3<P>(regular, scale * row, surface.row[a]);
  }
}

template <bool with_hessian, class P>
GELFLOW_INLINE void ellipsoid_distance(const Vec3<P>& x, const Vec3<P>& axes, Distance<P>& out) {
  using std::sqrt;
  const P zero(0.0), one(1.0);
  const Vec3<P> square{axes.x * axes.x, axes.y * axes.y, axes.z * axes.z};
  Vec3<P> scaled;
  P t(-1e30);
  for (int a = 0; a < 3; ++a) {
    scaled[a] = axes[a] * x[a];
    const P lower = select(x[a] < zero, -scaled[a], scaled[a]) - square[a];
    t = select(lower > t, lower, t);
  }
  const P size = square.x + square.y + square.z;
  for (int remaining = 3, k = 0; remaining > 0 && k < 80; ++k) {  // derivatives of dual numbers converge later
    const P change = ellipsoid_step(scaled, square, t);
    t += change;
    if (!any(change > P(1e-12) * size)) --remaining;
  }
  Vec3<P> gradient;
  P rest = one;
  for (int a = 0; a < 3; ++a) {
    const P divisor = square[a] + t;
    const Mask<P> regular = divisor > P(1e-12) * square[a];
    gradient[a] = select(regular, x[a] / select(regular, divisor, one), zero);
    rest -= square[a] * gradient[a] * gradient[a];
  }
  // If an axis has no regular divisor, the rest of the surface equation determines the gradient along it.
  for (int a = 0; a < 3; ++a) {
    const Mask<P> open = !(square[a] + t > P(1e-12) * square[a]) && rest > zero;
    const P length = sqrt(select(open, rest, one)) / axes[a];
    gradient[a] = select(open, length, gradient[a]);
    rest = select(open, zero, rest);
  }
  const P steepness = sqrt(dot(gradient, gradient)), inverse = one / steepness;
  out.d = t * steepness;
  out.n = inverse * gradient;
  out.form = HessianForm::general;
  if constexpr (with_hessian) ellipsoid_hessian(square, inverse, out);
}

}  // namespace gelflow
