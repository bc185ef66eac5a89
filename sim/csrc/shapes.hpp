// Signed distance of points to a shape, in the shape's frame: d < 0 inside, n = ∇d, H = ∇²d. Nothing else.
//
// Only what is inside is touched, so the distance is exact inside; outside it has the right sign. Where a distance has
// no gradient (a sphere's centre, a box's medial surface) one branch is taken, always the same: +x at a sphere's centre;
// inside a box the face with the largest (least negative) distance, x before y before z.
#pragma once

#include "lanes.hpp"
#include "model.hpp"

namespace gelflow {

template <class L>
struct Distance {
  L d;
  Vec3<L> n;
  Mat3<L> hessian;  // only written where curved
  bool curved;      // of the shape's kind, the same for all its points
};

template <class L>
GELFLOW_INLINE void plane_distance(const Vec3<L>& x, Distance<L>& out) {  // the half space z < 0
  out.d = x.z;
  out.n = {L(0.0), L(0.0), L(1.0)};
  out.curved = false;
}

template <class L>
GELFLOW_INLINE void sphere_distance(const Vec3<L>& x, const L& radius, Distance<L>& out) {
  using std::sqrt;
  const L zero(0.0), one(1.0), squared = dot(x, x);
  const Mask<L> center = squared < L(1e-30);
  const L length = sqrt(select(center, one, squared)), inverse = one / length;
  out.d = select(center, -radius, length - radius);
  out.n = select3<L>(center, Vec3<L>{one, zero, zero}, inverse * x);
  out.hessian = select(center, zero, inverse) * identity_minus_outer(out.n);
  out.curved = true;
}

template <class L>
GELFLOW_INLINE void box_distance(const Vec3<L>& x, const Vec3<L>& half, Distance<L>& out) {
  const L zero(0.0), one(1.0);
  Vec3<L> sign, beyond;  // of the faces on the point's side
  for (int a = 0; a < 3; ++a) {
    sign[a] = select(x[a] < zero, -one, one);
    beyond[a] = sign[a] * x[a] - half[a];
  }
  const Mask<L> y = beyond.y > beyond.x;
  const L larger = select(y, beyond.y, beyond.x);
  const Mask<L> z = beyond.z > larger;
  out.d = select(z, beyond.z, larger);
  out.n = {select(y || z, zero, sign.x), select(z, zero, select(y, sign.y, zero)), select(z, sign.z, zero)};
  out.curved = false;
}

template <class L, class T>
GELFLOW_INLINE void distance(ShapeKind kind, const T* size, const Vec3<L>& x, Distance<L>& out) {
  if (kind == ShapeKind::box) {
    box_distance<L>(x, {L(size[0]), L(size[1]), L(size[2])}, out);
  } else if (kind == ShapeKind::sphere) {
    sphere_distance<L>(x, L(size[0]), out);
  } else {
    plane_distance<L>(x, out);
  }
}

// The distance alone, right on both sides, for culling.
template <class T>
GELFLOW_INLINE T distance_only(ShapeKind kind, const T* size, const V3<T>& x) {
  using std::sqrt;
  if (kind == ShapeKind::plane) return x[2];
  if (kind == ShapeKind::sphere) return sqrt(x.squaredNorm()) - size[0];
  T inside = T(-1e30), squared = T(0);
  for (int a = 0; a < 3; ++a) {
    const T o = (x[a] < T(0) ? -x[a] : x[a]) - size[a];
    if (o > inside) inside = o;
    if (o > T(0)) squared += o * o;
  }
  return inside > T(0) ? sqrt(squared) : inside;
}

}  // namespace gelflow
