// Signed distance of points to a shape of any kind, in the shape's frame: d < 0 inside, n = ∇d, H = ∇²d.
#pragma once

#include "geometry/ellipsoid.hpp"
#include "geometry/grid_shape.hpp"
#include "geometry/primitive_shapes.hpp"
#include "geometry/rounded_shapes.hpp"
#include "model/model.hpp"

namespace gelflow {

// Less common shapes with longer code stay out of line, and so out of the loops of the others.
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

// Calls f(distance_at), where distance_at(x, out) evaluates a shape of this kind, so that f may loop over points with the
// dispatch outside the loop. `with_hessian`: out.hessian or out.curvature is set too.
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
        const Vec3<P> point = x;  // the call needs addresses
        Distance<P> result;
        uncommon_distance<with_hessian, P, T>(kind, size, grid, point, result);
        out = result;
      });
  }
}
template <bool with_hessian, class P, class T>
GELFLOW_INLINE void distance(ShapeKind kind, const T* size, const DistanceGrid* grid, const Vec3<P>& x,
                             Distance<P>& out) {
  with_distance<with_hessian, P, T>(kind, size, grid,
                                    [&](auto&& distance_at) GELFLOW_LOOP_BODY { distance_at(x, out); });
}

}  // namespace gelflow
