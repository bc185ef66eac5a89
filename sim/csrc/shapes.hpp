// Signed distance of a point to a shape, in the shape's frame: d < 0 inside, n = ∇d, H = ∇²d. Nothing else.
//
// Where a distance has no gradient (a sphere's centre, a box's medial surface) one branch is taken, always the same:
// +x at a sphere's centre; inside a box the face with the largest (least negative) distance, x before y before z.
#pragma once

#include "model.hpp"

namespace gelflow {

template <class T>
struct Distance {
  T d;
  V3<T> n;
  M3<T> hessian;  // only written where curved
  bool curved;
};

template <class T>
GELFLOW_INLINE void plane_distance(const V3<T>& x, Distance<T>& out) {  // the half space z < 0
  out.d = x[2];
  out.n = V3<T>(T(0), T(0), T(1));
  out.curved = false;
}

template <class T>
GELFLOW_INLINE void sphere_distance(const V3<T>& x, const T& radius, Distance<T>& out) {
  using std::sqrt;
  const T squared = x.squaredNorm();
  if (real_part(squared) < 1e-30) {
    out.d = -radius;
    out.n = V3<T>(T(1), T(0), T(0));
    out.curved = false;
    return;
  }
  const T length = sqrt(squared);
  out.d = length - radius;
  out.n = x / length;
  out.curved = true;
  out.hessian = (M3<T>::Identity() - out.n * out.n.transpose()) / length;
}

template <class T>
void box_distance(const V3<T>& x, const V3<T>& half, Distance<T>& out) {
  using std::sqrt;
  V3<T> sign, outside;
  int beyond = 0, deepest = 0;
  for (int a = 0; a < 3; ++a) {
    sign[a] = x[a] < T(0) ? T(-1) : T(1);
    outside[a] = sign[a] * x[a] - half[a];
    if (outside[a] > T(0)) ++beyond;
    if (outside[a] > outside[deepest]) deepest = a;
  }
  if (beyond <= 1) {  // inside, or in front of one face
    out.d = outside[deepest];
    out.n = V3<T>::Zero();
    out.n[deepest] = sign[deepest];
    out.curved = false;
    return;
  }
  V3<T> excess;
  for (int a = 0; a < 3; ++a) excess[a] = outside[a] > T(0) ? outside[a] : T(0);
  out.d = sqrt(excess.squaredNorm());
  out.n = excess.cwiseProduct(sign) / out.d;
  out.curved = true;
  out.hessian = -out.n * out.n.transpose();
  for (int a = 0; a < 3; ++a) {
    if (outside[a] > T(0)) out.hessian(a, a) += T(1);
  }
  out.hessian /= out.d;
}

template <class T>
GELFLOW_INLINE void distance(ShapeKind kind, const T* size, const V3<T>& x, Distance<T>& out) {
  if (kind == ShapeKind::box) {
    box_distance<T>(x, V3<T>(size[0], size[1], size[2]), out);
  } else if (kind == ShapeKind::sphere) {
    sphere_distance<T>(x, size[0], out);
  } else {
    plane_distance<T>(x, out);
  }
}

// The distance alone, for culling.
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
