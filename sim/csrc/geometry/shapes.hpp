// Signed distance of points to a shape, in the shape's frame: d < 0 inside, n = ∇d, H = ∇²d. Nothing else.
//
// Only what is inside is touched, so the distance is exact inside; outside it has the right sign. Where a distance has
// no gradient one branch is taken, always the same: +x at the centre of a sphere and on the axis of a cylinder or capsule;
// inside a box the face with the largest (least negative) distance, x before y before z; in a cylinder the wall before
// the ends. Cylinders, capsules and ellipsoids have their sizes in MuJoCo's order: radius and half length along z; half
// axes. A shape that a grid describes has a smooth field in place of a distance (grid_shape.hpp).
#pragma once

#include <algorithm>

#include "geometry/grid_shape.hpp"
#include "model/model.hpp"

namespace gelflow {

template <class P>
GELFLOW_INLINE void plane_distance(const Vec3<P>& x, Distance<P>& out) {  // the half space z < 0
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
  Vec3<P> sign, beyond;  // of the faces on the point's side
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

// Length of (x, y) and its direction, +x on the axis; `inverse` is 1/length, 0 on the axis.
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
  const Vec3<P> outwards = radial(x, length, inverse);
  const P sign = select(x.z < zero, -one, one), wall = length - radius, end = sign * x.z - half;
  const Mask<P> flat = end > wall;
  out.d = select(flat, end, wall);
  out.n = select3<P>(flat, {zero, zero, sign}, outwards);
  if constexpr (with_hessian) {
    const Vec3<P> around{-outwards.y, outwards.x, zero};
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
  // Beside the segment nothing changes along it: (1 − n nᵀ − z zᵀ)/length.
  if constexpr (with_hessian) {
    out.hessian = out.hessian_matrix();
    out.hessian.row[2] = select3<P>(along, zero3<P>(), out.hessian.row[2]);
  }
  out.form = HessianForm::general;
}

// One Newton step for t in Σ (a x/(a² + t))² = 1, on whose left end it starts: it then never steps over the root.
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
  const Mask<P> goes = slope < P(-1e-30) && value > zero;
  return select(goes, -value / select(goes, slope, one), zero);
}

// The nearest point y of the ellipsoid has x − y = t g with g = y/a²: y = a² x/(a² + t), d = t ‖g‖, n = g/‖g‖. In the
// middle, where all is equally far along the shortest axis, its positive end is taken.
template <bool with_hessian, class P>
GELFLOW_INLINE void ellipsoid_distance(const Vec3<P>& x, const Vec3<P>& axes, Distance<P>& out) {
  using std::sqrt;
  const P zero(0.0), one(1.0);
  const Vec3<P> square{axes.x * axes.x, axes.y * axes.y, axes.z * axes.z};
  Vec3<P> scaled;
  P t(-1e30);
  for (int a = 0; a < 3; ++a) {
    scaled[a] = axes[a] * x[a];
    const P lowest = select(x[a] < zero, -scaled[a], scaled[a]) - square[a];
    t = select(lowest > t, lowest, t);
  }
  const P size = square.x + square.y + square.z;
  for (int more = 3, k = 0; more > 0 && k < 80; ++k) {  // past convergence a dual number's derivative follows
    const P change = ellipsoid_step(scaled, square, t);
    t += change;
    if (!any(change > P(1e-12) * size)) --more;
  }
  Vec3<P> gradient;
  P rest = one;
  for (int a = 0; a < 3; ++a) {
    const P divisor = square[a] + t;
    const Mask<P> regular = divisor > P(1e-12) * square[a];
    gradient[a] = select(regular, x[a] / select(regular, divisor, one), zero);
    rest -= square[a] * gradient[a] * gradient[a];
  }
  // What is missing on the surface belongs to the axis without a regular divisor, where there is one.
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
  if constexpr (!with_hessian) return;
  // Curvature of the surface S = P diag(1/a²) P/‖g‖ with P = 1 − n nᵀ, and of the parallel surface (1 + d S)⁻¹ S.
  const Mat3<P> project = identity_minus_outer(out.n);
  Mat3<P> surface = zero33<P>();
  for (int a = 0; a < 3; ++a) surface += inverse / square[a] * outer(project.row[a], project.row[a]);
  Mat3<P> moved = out.d * surface;
  for (int a = 0; a < 3; ++a) moved.row[a][a] += one;
  const Mat3<P> cofactors{cross(moved.row[1], moved.row[2]), cross(moved.row[2], moved.row[0]),
                          cross(moved.row[0], moved.row[1])};
  const P determinant = dot(moved.row[0], cofactors.row[0]);
  const Mask<P> regular = determinant > P(1e-6);  // not where the curvature's centre is
  const P scale = select(regular, one / select(regular, determinant, one), one);
  for (int a = 0; a < 3; ++a) {  // cofactors are symmetric here: they are the adjugate
    const Vec3<P> row = transposed_times(surface, cofactors.row[a]);
    out.hessian.row[a] = select3<P>(regular, scale * row, surface.row[a]);
  }
}

// A rounded solid is a smaller one, of sizes less r, grown by r. Beyond the smaller one it is r less than the distance
// to that, and smooth there: flat beside a face, round beside an edge or a corner. Inside the smaller one the nearest
// point lies on a face, as without rounding. The normal jumps inside the smaller solid alone, at least r deep.
template <class P>
GELFLOW_INLINE void rounded_box_distance(const Vec3<P>& x, const Vec3<P>& half, const P& rounding, Distance<P>& out) {
  using std::sqrt;
  const P zero(0.0), one(1.0);
  const Vec3<P> inner{half.x - rounding, half.y - rounding, half.z - rounding};
  box_distance<P>(x, inner, out);  // what holds inside the smaller box
  Vec3<P> gap, round;              // to the smaller box; 1 along the axes that have one
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
  const Vec3<P> outwards = radial(x, length, around);
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
  out.n = {across * outwards.x, across * outwards.y, along};
  // Round about the axis, and about the edge of the smaller cylinder.
  const Vec3<P> ring{-outwards.y, outwards.x, zero}, edge{-along * outwards.x, -along * outwards.y, across};
  out.hessian =
      across * around * outer(ring, ring) + select(beside && above && !deep, inverse, zero) * outer(edge, edge);
  out.form = HessianForm::general;
}

// Kinds that are rarer and longer stay out of the loops of the others.
template <bool with_hessian, class P, class T>
__attribute__((noinline)) void uncommon_distance(ShapeKind kind, const T* size, const DistanceGrid* grid,
                                                 const Vec3<P>& x, Distance<P>& out) {
  if (kind == ShapeKind::ellipsoid) {
    return ellipsoid_distance<with_hessian, P>(x, {P(size[0]), P(size[1]), P(size[2])}, out);
  }
  if (kind == ShapeKind::rounded_box) {
    return rounded_box_distance<P>(x, {P(size[0]), P(size[1]), P(size[2])}, P(size[3]), out);
  }
  if (kind == ShapeKind::rounded_cylinder) {
    return rounded_cylinder_distance<P>(x, P(size[0]), P(size[1]), P(size[3]), out);
  }
  grid_distance<P>(*grid, P(size[0]), x, out);
}

// Calls f(of), where of(x, out) is what a shape of this kind says of points. `curved`: the Hessian is asked for too.
template <bool with_hessian, class P, class T, class F>
GELFLOW_INLINE void with_distance(ShapeKind kind, const T* size, const DistanceGrid* grid, F&& f) {
  switch (kind) {
    case ShapeKind::plane:
      return f([](const Vec3<P>& x, Distance<P>& out) GELFLOW_LOOP_BODY { plane_distance<P>(x, out); });
    case ShapeKind::sphere: {
      const P radius(size[0]);
      return f([=](const Vec3<P>& x, Distance<P>& out)
                   GELFLOW_LOOP_BODY { sphere_distance<with_hessian, P>(x, radius, out); });
    }
    case ShapeKind::box: {
      const Vec3<P> half{P(size[0]), P(size[1]), P(size[2])};
      return f([=](const Vec3<P>& x, Distance<P>& out) GELFLOW_LOOP_BODY { box_distance<P>(x, half, out); });
    }
    case ShapeKind::cylinder: {
      const P radius(size[0]), half(size[1]);
      return f([=](const Vec3<P>& x, Distance<P>& out)
                   GELFLOW_LOOP_BODY { cylinder_distance<with_hessian, P>(x, radius, half, out); });
    }
    case ShapeKind::capsule: {
      const P radius(size[0]), half(size[1]);
      return f([=](const Vec3<P>& x, Distance<P>& out)
                   GELFLOW_LOOP_BODY { capsule_distance<with_hessian, P>(x, radius, half, out); });
    }
    [[unlikely]] default:
      return f([=](const Vec3<P>& x, Distance<P>& out) GELFLOW_LOOP_BODY {
        const Vec3<P> at = x;  // called, they need places in memory
        Distance<P> found;
        uncommon_distance<with_hessian, P, T>(kind, size, grid, at, found);
        out = found;
      });
  }
}
template <bool with_hessian, class P, class T>
GELFLOW_INLINE void distance(ShapeKind kind, const T* size, const DistanceGrid* grid, const Vec3<P>& x,
                             Distance<P>& out) {
  with_distance<with_hessian, P, T>(kind, size, grid, [&](auto&& of) GELFLOW_LOOP_BODY { of(x, out); });
}

// One number of the rarer kinds' bounds.
template <class T>
__attribute__((noinline)) T uncommon_bound(ShapeKind kind, const T* size, const DistanceGrid* grid, T x, T y, T z) {
  if (kind == ShapeKind::grid) return grid_bound<T>(*grid, size[0], {x, y, z});
  const V3<T> scaled(x / size[0], y / size[1], z / size[2]);
  return (std::sqrt(scaled.squaredNorm()) - T(1)) * std::min({size[0], size[1], size[2]});
}

// A distance that nothing is nearer than, for culling: exact outside but for the ellipsoid, the grid, and rounded
// edges, which count as sharp; negative inside.
template <class P, class T>
GELFLOW_INLINE P distance_bound(ShapeKind kind, const T* size, const DistanceGrid* grid, const Vec3<P>& x) {
  const P zero(0.0);
  const auto positive = [&](const P& a) { return select(a > zero, a, zero); };
  const auto larger = [](const P& a, const P& b) { return select(a > b, a, b); };
  switch (kind) {
    case ShapeKind::plane:
      return x.z;
    case ShapeKind::sphere:
      return sqrt(dot(x, x)) - P(size[0]);
    case ShapeKind::box:
    case ShapeKind::rounded_box: {
      const Vec3<P> over{abs(x.x) - P(size[0]), abs(x.y) - P(size[1]), abs(x.z) - P(size[2])};
      const P inside = larger(over.x, larger(over.y, over.z));
      const Vec3<P> gap{positive(over.x), positive(over.y), positive(over.z)};
      return select(inside > zero, sqrt(dot(gap, gap)), inside);
    }
    case ShapeKind::capsule: {
      const P along = positive(abs(x.z) - P(size[1]));
      return sqrt(x.x * x.x + x.y * x.y + along * along) - P(size[0]);
    }
    case ShapeKind::cylinder:
    case ShapeKind::rounded_cylinder: {
      const P wall = sqrt(x.x * x.x + x.y * x.y) - P(size[0]), end = abs(x.z) - P(size[1]);
      const P inside = larger(wall, end), gap_wall = positive(wall), gap_end = positive(end);
      return select(inside > zero, sqrt(gap_wall * gap_wall + gap_end * gap_end), inside);
    }
    default:
      break;
  }
  P bound = zero;
  for (int i = 0; i < lane_count<P>; ++i) {
    set_lane(bound, i, uncommon_bound<T>(kind, size, grid, lane(x.x, i), lane(x.y, i), lane(x.z, i)));
  }
  return bound;
}

}  // namespace gelflow
