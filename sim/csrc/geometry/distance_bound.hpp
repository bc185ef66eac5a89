// Lower bounds of the distance to a shape, for the broad phase.
#pragma once

#include <algorithm>

#include "geometry/grid_shape.hpp"
#include "model/model.hpp"

namespace gelflow {

// Bound of one point for the less common shapes.
template <class T>
__attribute__((noinline)) T uncommon_bound(ShapeKind kind, const T* size, const DistanceGrid* grid, T x, T y, T z) {
  if (kind == ShapeKind::grid) return grid_bound<T>(*grid, size[0], {x, y, z});
  const V3<T> scaled(x / size[0], y / size[1], z / size[2]);
  return (std::sqrt(scaled.squaredNorm()) - T(1)) * std::min({size[0], size[1], size[2]});
}

// Lower bound of the distance for culling, negative inside. Outside it is exact except for ellipsoids, grids, and rounded
// edges, which are treated as sharp.
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
