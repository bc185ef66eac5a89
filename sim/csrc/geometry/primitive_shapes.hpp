// Signed distance to planes, spheres, boxes, cylinders and capsules.
//
// Only points inside a shape are in contact: the distance is exact inside, and outside it has the right sign. Where it
// has no gradient, one branch is chosen: +x at the centre of a sphere and on the axis of a cylinder or capsule; inside a
// box the face with the largest (least negative) distance, x before y before z; in a cylinder the wall before the ends.
// Sizes are in MuJoCo's order: radius, then half length along z.
#pragma once

#include "geometry/distance.hpp"

namespace gelflow {

template <class P>
GELFLOW_INLINE void plane_distance(const Vec3<P>& x, Distance<P>& out) {  // half space z < 0
  out.d = x.z;
  out.n = {P(0.0), P(0.0), P(1.0)};
  out.form = HessianForm::zero;
}

template <bool with_hessian, class P>
GELFLOW_INLINE void sphere_distance(const Vec3<P>& x, const P& radius, Distance<P>& out) {
  using std::sqrt;
  const P zero(0.0), one(1.0), squared = dot(x, x);
  const Mask<P> center = squared < P(1e-30);
  const P length = sqrt(squared), inverse = one / length;
  out.d = length - radius;
  out.n = inverse * x;
  if (any(center)) [[unlikely]] {
    out.d = select(center, -radius, out.d);
    out.n = select3<P>(center, Vec3<P>{one, zero, zero}, out.n);
  }
  if constexpr (with_hessian) out.curvature = select(center, zero, inverse);
  out.form = HessianForm::isotropic;
}

template <class P>
GELFLOW_INLINE void box_distance(const Vec3<P>& x, const Vec3<P>& half, Distance<P>& out) {
  const P zero(0.0), one(1.0);
  Vec3<P> sign, beyond;  // beyond: distance to the face on the point's side
  for (int a = 0; a < 3; ++a) {
    sign[a] = select(x[a] < zero, -one, one);
    beyond[a] = sign[a] * x[a] - half[a];
  }
  const Mask<P> y = beyond.y > beyond.x;
  const P larger = select(y, beyond.y, beyond.x);
  const Mask<P> z = beyond.z > larger;
  out.d = select(z, beyond.z, larger);
  out.n = {select(y || z, zero, sign.x), select(z, zero, select(y, sign.y, zero)), select(z, sign.z, zero)};
  out.form = HessianForm::zero;
}

// Length and direction of (x, y); on the z axis the direction is +x. `inverse` is 1/length, 0 on the axis.
template <class P>
GELFLOW_INLINE Vec3<P> radial(const Vec3<P>& x, P& length, P& inverse) {
  using std::sqrt;
  const P zero(0.0), one(1.0), squared = x.x * x.x + x.y * x.y;
  const Mask<P> axis = squared < P(1e-30);
  const P root = sqrt(select(axis, one, squared));
  length = select(axis, zero, root);
  inverse = select(axis, zero, one / root);
  return select3<P>(axis, {one, zero, zero}, {inverse * x.x, inverse * x.y, zero});
}

template <bool with_hessian, class P>
GELFLOW_INLINE void cylinder_distance(const Vec3<P>& x, const P& radius, const P& half, Distance<P>& out) {
  const P zero(0.0), one(1.0);
  P length, inverse;
  const Vec3<P> outward = radial(x, length, inverse);
  const P sign = select(x.z < zero, -one, one), wall = length - radius, end = sign * x.z - half;
  const Mask<P> flat = end > wall;
  out.d = select(flat, end, wall);
  out.n = select3<P>(flat, {zero, zero, sign}, outward);
  if constexpr (with_hessian) {
    const Vec3<P> around{-outward.y, outward.x, zero};
    out.hessian = select(flat, zero, inverse) * outer(around, around);
  }
  out.form = HessianForm::general;
}

template <bool with_hessian, class P>
GELFLOW_INLINE void capsule_distance(const Vec3<P>& x, const P& radius, const P& half, Distance<P>& out) {
  const P zero(0.0);
  const P nearest = select(x.z > half, half, select(x.z < -half, -half, x.z));
  [[maybe_unused]] const Mask<P> along = !(x.z > half) && !(x.z < -half);
  sphere_distance<with_hessian, P>({x.x, x.y, x.z - nearest}, radius, out);
  // Beside the segment the distance does not depend on z: (1 − n nᵀ − z zᵀ)/length.
  if constexpr (with_hessian) {
    out.hessian = out.hessian_matrix();
    out.hessian.row[2] = select3<P>(along, zero3<P>(), out.hessian.row[2]);
  }
  out.form = HessianForm::general;
}

}  // namespace gelflow
