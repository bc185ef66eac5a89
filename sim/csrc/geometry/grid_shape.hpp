// Evaluation of a signed distance grid (meshes).
//
// With u = (x/s − o)/h the position in cells (o the grid's origin, h its spacing, s the scale of the shape), i = ⌊u⌋ per
// axis and t = u − i, the spline and its derivatives are
//     φ = Σ c_{i+a, j+b, k+c} B_a(t_x) B_b(t_y) B_c(t_z),   a, b, c = 0…3
//     d = s φ,   n = φ'/h,   H = φ''/(h² s)
// with the four pieces of the cubic B-spline (s' = 1 − t)
//     B = s'³/6,  2/3 − t² + t³/2,  2/3 − s'² + s'³/2,  t³/6
// φ has continuous second derivatives. n is the exact gradient of d and not of unit length: the better the grid resolves
// the shape, the closer ‖n‖ is to 1.
#pragma once

#include <cmath>

#include "geometry/distance.hpp"
#include "geometry/distance_grid.hpp"

namespace gelflow {

template <class P>
struct SplineBasis {
  P value[4], first[4], second[4];
};

template <class P>
GELFLOW_INLINE void spline_basis(const P& t, SplineBasis<P>& p) {
  const P s = P(1.0) - t, tt = t * t, ss = s * s, half(0.5), sixth(1.0 / 6), two_thirds(2.0 / 3);
  p.value[0] = sixth * ss * s;
  p.value[1] = two_thirds - tt * (P(1.0) - half * t);
  p.value[2] = two_thirds - ss * (P(1.0) - half * s);
  p.value[3] = sixth * tt * t;
  p.first[0] = -half * ss;
  p.first[1] = t * (P(1.5) * t - P(2.0));
  p.first[2] = s * (P(2.0) - P(1.5) * s);
  p.first[3] = half * tt;
  p.second[0] = s;
  p.second[1] = P(3.0) * t - P(2.0);
  p.second[2] = P(3.0) * s - P(2.0);
  p.second[3] = t;
}

// Index of the cell at position u along one axis, clamped to the grid; the first cell for NaN.
GELFLOW_INLINE int grid_cell(double u, int cells) {
  const double last = cells - 1;
  return static_cast<int>(u > 0 ? (u < last ? u : last) : 0.0);
}

// The spline and its derivatives in cells, not yet scaled.
template <class P>
struct SplineSums {
  P value;
  Vec3<P> gradient;
  P xx, yy, zz, xy, xz, yz;
};

// Sums over the 4 × 4 × 4 coefficients from start[lane] on, one axis after the other.
template <class P>
GELFLOW_INLINE void sum_spline(const DistanceGrid& g, const float* const* start, const SplineBasis<P>& px,
                               const SplineBasis<P>& py, const SplineBasis<P>& pz, SplineSums<P>& sums) {
  const P zero(0.0);
  sums.value = zero;
  sums.gradient = zero3<P>();
  sums.xx = sums.yy = sums.zz = sums.xy = sums.xz = sums.yz = zero;
  for (int i = 0; i < 4; ++i) {
    P plane = zero, d_y = zero, d_z = zero, d_yy = zero, d_yz = zero, d_zz = zero;
    for (int j = 0; j < 4; ++j) {
      const std::ptrdiff_t row = i * g.stride(0) + j * g.stride(1);
      P line = zero, line_z = zero, line_zz = zero;
      for (int k = 0; k < 4; ++k) {
        const P c = gather<P>(start, row + k);
        line += pz.value[k] * c;
        line_z += pz.first[k] * c;
        line_zz += pz.second[k] * c;
      }
      plane += py.value[j] * line;
      d_y += py.first[j] * line;
      d_yy += py.second[j] * line;
      d_z += py.value[j] * line_z;
      d_yz += py.first[j] * line_z;
      d_zz += py.value[j] * line_zz;
    }
    sums.value += px.value[i] * plane;
    sums.gradient += Vec3<P>{px.first[i] * plane, px.value[i] * d_y, px.value[i] * d_z};
    sums.xx += px.second[i] * plane;
    sums.xy += px.first[i] * d_y;
    sums.xz += px.first[i] * d_z;
    sums.yy += px.value[i] * d_yy;
    sums.yz += px.value[i] * d_yz;
    sums.zz += px.value[i] * d_zz;
  }
}

template <class P>
GELFLOW_INLINE void grid_distance(const DistanceGrid& g, const P& scale, const Vec3<P>& x, Distance<P>& out) {
  constexpr int width = lane_count<P>;
  using T = PackScalar<P>;
  const P zero(0.0), one(1.0), per_cell = P(T(1 / g.spacing)) / scale;
  const float* start[width];
  for (int l = 0; l < width; ++l) start[l] = g.coefficients.data();
  SplineBasis<P> along[3];
  Mask<P> within = one > zero;
  for (int a = 0; a < 3; ++a) {
    const P u = per_cell * x[a] - P(T(g.origin[a] / g.spacing));
    within = within && u > zero && u < P(T(g.cells[a]));
    P cell;
    for (int l = 0; l < width; ++l) {
      const int i = grid_cell(real_part(lane(u, l)), g.cells[a]);
      start[l] += static_cast<std::ptrdiff_t>(i) * g.stride(a);
      set_lane(cell, l, T(i));
    }
    spline_basis<P>(u - cell, along[a]);
  }
  SplineSums<P> sums;
  sum_spline<P>(g, start, along[0], along[1], along[2], sums);
  const P per_meter(T(1 / g.spacing));
  out.d = select(within, scale * sums.value, one);
  out.n = select3<P>(within, per_meter * sums.gradient, {one, zero, zero});
  const P second_scale = select(within, per_cell * per_meter, zero);
  out.hessian =
      second_scale * Mat3<P>{{sums.xx, sums.xy, sums.xz}, {sums.xy, sums.yy, sums.yz}, {sums.xz, sums.yz, sums.zz}};
  out.form = HessianForm::field;
}

// Lower bound of the distance to any point where the spline is negative, for culling. Outside the grid's box the distance
// to the box bounds it.
template <class T>
__attribute__((noinline)) T grid_bound(const DistanceGrid& g, const T& scale, const V3<T>& x) {
  const double edge = g.spacing * real_part(scale);
  double squared = 0;
  int cell[3];
  for (int a = 0; a < 3; ++a) {
    const double u = real_part(x[a]) / edge - g.origin[a] / g.spacing, upper = g.cells[a];
    const double beyond = u < 0 ? -u : u > upper ? u - upper : 0.0;
    squared += beyond * beyond;
    cell[a] = grid_cell(u, g.cells[a]);
  }
  const double between = g.clearance[static_cast<std::size_t>(g.cell(cell[0], cell[1], cell[2]))] - 1.0;
  return T(edge * std::max(std::sqrt(squared), between));
}

}  // namespace gelflow
