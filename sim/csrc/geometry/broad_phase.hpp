// Broad phase: the points of a cloud that may touch a shape, by bounding spheres of blocks and by single points.
#pragma once

#include <bit>

#include "geometry/pair_frame.hpp"

namespace gelflow {

constexpr double rounding_margin = 1e-6;  // [m], above the rounding errors of single precision

// Calls visit(first, last) for runs of the blocks from … to whose bounding spheres reach into the shape offset by
// `margin`.
template <bool scaled, class T, class Visit>
GELFLOW_INLINE void for_candidate_blocks(const PairFrame<T>& f, const PointCloud::Blocks& blocks, int from, int to,
                                         const T& margin, Visit&& visit) {
  using P = Pack<T>;
  for (int b = from; b < to; b += pack_width<T>) {
    const Vec3<P> center{load<P>(&blocks.center.x[b]), load<P>(&blocks.center.y[b]), load<P>(&blocks.center.z[b])};
    const P radius = load<P>(&blocks.radius[b]);
    const P reach = (scaled ? P(f.max_scale) * radius : radius) + P(margin);
    unsigned candidates = bits(f.template may_reach<scaled, P>(center, reach) && first_lanes<P>(to - b));
    while (candidates != 0) {
      const int first = std::countr_zero(candidates), count = std::countr_one(candidates >> first);
      visit(b + first, b + first + count);
      candidates &= ~0U << (first + count);
    }
  }
}

// Calls visit(begin, end) for ranges of points, some of which may lie inside the shape offset by `margin`. Two levels:
// groups, then their leaves.
template <bool scaled, class T, class Visit>
GELFLOW_INLINE void for_candidate_leaves(const PairFrame<T>& f, const PointCloud& cloud, const T& margin,
                                         Visit&& visit) {
  const T grown = margin + T(rounding_margin);
  for_candidate_blocks<scaled, T>(f, cloud.groups, 0, cloud.groups.count(), grown, [&](int first, int last) {
    for_candidate_blocks<scaled, T>(
        f, cloud.leaves, cloud.groups.begin[first], cloud.groups.end[last - 1], grown,
        [&](int begin, int end) { visit(cloud.leaves.begin[begin], cloud.leaves.end[end - 1]); });
  });
}

// The broad phase uses values only: a pair frame without derivatives. `size` stores the shape's sizes.
template <class T>
PairFrame<double> value_frame(const PairFrame<T>& f, double* size) {
  PairFrame<double> value;
  for (int i = 0; i < 3; ++i) {
    size[i] = real_part(f.size[i]);
    for (int j = 0; j < 3; ++j) value.rotation(i, j) = real_part(f.rotation(i, j));
    value.offset[i] = real_part(f.offset[i]);
    value.local[i] = real_part(f.local[i]);
  }
  value.size = size;
  value.kind = f.kind;
  value.grid = f.grid;
  value.scaled = true;
  value.max_scale = f.scaled ? real_part(f.max_scale) : 1.0;
  value.plane_height = real_part(f.plane_height);
  return value;
}

template <class T, class Visit>
GELFLOW_INLINE void for_candidate_leaves(const PairFrame<T>& f, const PointCloud& cloud, const T& margin,
                                         Visit&& visit) {
  if constexpr (std::is_floating_point_v<T>) {
    if (f.scaled) return for_candidate_leaves<true, T>(f, cloud, margin, visit);
    return for_candidate_leaves<false, T>(f, cloud, margin, visit);
  } else {
    double size[3];
    for_candidate_leaves<true, double>(value_frame(f, size), cloud, real_part(margin), visit);
  }
}

// Calls visit(i) for the points begin … end that may be nearer to the shape than `reach`.
template <class T, class Visit>
GELFLOW_INLINE void for_points_in_reach(const PairFrame<T>& f, const double* x, const double* y, const double* z,
                                        int begin, int end, const T& reach, Visit&& visit) {
  using P = Pack<T>;
  const P grown = P(reach + T(rounding_margin));
  for (int i = begin; i < end; i += pack_width<T>) {
    const Vec3<P> point{load<P>(x + i), load<P>(y + i), load<P>(z + i)};
    const Mask<P> reaches =
        f.scaled ? f.template may_reach<true, P>(point, grown) : f.template may_reach<false, P>(point, grown);
    unsigned candidates = bits(reaches && first_lanes<P>(end - i));
    for (; candidates != 0; candidates &= candidates - 1) visit(i + std::countr_zero(candidates));
  }
}

// Calls visit(i) for all points of a cloud that may be nearer to the shape than `reach`.
template <class T, class Visit>
void for_candidate_points(const PairFrame<T>& f, const PointCloud& cloud, const T& reach, Visit&& visit) {
  if constexpr (std::is_floating_point_v<T>) {
    const PointCloud::Coordinates& p = cloud.points;
    for_candidate_leaves<T>(f, cloud, reach, [&](int begin, int end) {
      for_points_in_reach<T>(f, p.x.data(), p.y.data(), p.z.data(), begin, end, reach, visit);
    });
  } else {
    double size[3];
    for_candidate_points<double>(value_frame(f, size), cloud, real_part(reach), visit);
  }
}

}  // namespace gelflow
