// Signed distance to boxes and cylinders with rounded edges.
//
// A rounded solid is an inner solid, smaller by the rounding r, offset by r. Outside the inner solid the distance is the
// distance to it less r, which is smooth: flat beside a face, curved beside an edge or corner. Inside the inner solid the
// nearest point lies on a face, as without rounding. The normal is discontinuous only there, at least r deep.
#pragma once

#include "geometry/primitive_shapes.hpp"

namespace gelflow {

template <class P>
GELFLOW_INLINE void rounded_box_distance(const Vec3<P>& x, const Vec3<P>& half, const P& rounding, Distance<P>& out) {
  using std::sqrt;
  const P zero(0.0), one(1.0);
  const Vec3<P> inner{half.x - rounding, half.y - rounding, half.z - rounding};
  box_distance<P>(x, inner, out);  // applies inside the inner box
  Vec3<P> gap, round;              // to the inner box; 1 along the axes with a gap
  for (int a = 0; a < 3; ++a) {
    const Mask<P> below = x[a] < zero;
    const P over = select(below, -x[a], x[a]) - inner[a];
    const Mask<P> beyond = over > zero;
    gap[a] = select(beyond, select(below, -over, over), zero);
    round[a] = select(beyond, one, zero);
  }
  const P squared = dot(gap, gap);
  const Mask<P> deep = squared < P(1e-30);
  const P length = sqrt(select(deep, one, squared)), inverse = select(deep, zero, one / length);
  out.d = select(deep, out.d, length) - rounding;
  out.n = select3<P>(deep, out.n, inverse * gap);
  out.hessian = -inverse * outer(out.n, out.n);
  for (int a = 0; a < 3; ++a) out.hessian.row[a][a] += inverse * round[a];
  out.form = HessianForm::general;
}

template <class P>
GELFLOW_INLINE void rounded_cylinder_distance(const Vec3<P>& x, const P& radius, const P& half, const P& rounding,
                                              Distance<P>& out) {
  using std::sqrt;
  const P zero(0.0), one(1.0);
  P length, around;
  const Vec3<P> outward = radial(x, length, around);
  const P sign = select(x.z < zero, -one, one);
  const P wall = length - (radius - rounding), end = sign * x.z - (half - rounding);
  const Mask<P> flat = end > wall, beside = wall > zero, above = end > zero;
  const P gap_wall = select(beside, wall, zero), gap_end = select(above, end, zero);
  const P squared = gap_wall * gap_wall + gap_end * gap_end;
  const Mask<P> deep = squared < P(1e-30);
  const P root = sqrt(select(deep, one, squared)), inverse = one / root;
  const P across = select(deep, select(flat, zero, one), inverse * gap_wall);
  const P along = sign * select(deep, select(flat, one, zero), inverse * gap_end);
  out.d = select(deep, select(flat, end, wall), root) - rounding;
  out.n = {across * outward.x, across * outward.y, along};
  // Curvature about the axis, and about the edge of the inner cylinder.
  const Vec3<P> ring{-outward.y, outward.x, zero}, edge{-along * outward.x, -along * outward.y, across};
  out.hessian =
      across * around * outer(ring, ring) + select(beside && above && !deep, inverse, zero) * outer(edge, edge);
  out.form = HessianForm::general;
}

}  // namespace gelflow
