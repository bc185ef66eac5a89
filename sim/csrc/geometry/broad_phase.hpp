// Which points of a cloud may touch a shape.
#pragma once

#include <bit>

#include "contact/pair_frame.hpp"

namespace gelflow {

constexpr double rounding_margin = 1e-6;  // [m], above the rounding of single precision

// What the points of one cloud need besides their places.
template <class T>
struct ContactSettings {
  const T* params;  // kn, kt, mu, kd, ks
  FrictionLaw law;
  DampingLaw damping;
  T rolling_radius;              // 0: the points themselves touch
  const V3<T>* anchors;          // of this cloud against this shape
  const std::uint8_t* anchored;  // both unused under the viscous law
  double continuation = 1;       // share of k_t and k_s that is at work
  T h = T(0);                    // length of the step, where one is taken
};

// Calls visit(first, last) for runs of blocks, among from … to, that may reach into the shape grown by `margin`.
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

// Calls visit(begin, end) for neighbours in the cloud, some of which may be inside the shape grown by `margin`.
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

// What is near is no matter of derivatives: the frame of a run whose numbers carry some.
template <class T>
PairFrame<double> value_frame(const PairFrame<T>& f, double* size) {
  PairFrame<double> real;
  for (int i = 0; i < 3; ++i) {
    size[i] = real_part(f.size[i]);
    for (int j = 0; j < 3; ++j) real.rotation(i, j) = real_part(f.rotation(i, j));
    real.offset[i] = real_part(f.offset[i]);
    real.local[i] = real_part(f.local[i]);
  }
  real.size = size;
  real.kind = f.kind;
  real.grid = f.grid;
  real.scaled = true;
  real.max_scale = f.scaled ? real_part(f.max_scale) : 1.0;
  real.plane_height = real_part(f.plane_height);
  return real;
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

// Calls visit(i) for those of the points begin … end that may be nearer to the shape than `reach`.
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

// The same for all points of a cloud.
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

// The weights of points, scaled with their body: `weight` is that of the scale 1.
template <class T>
GELFLOW_INLINE T scaled_weight(const PairFrame<T>& f, const PointCloud& cloud, int i) {
  const T weight(cloud.weights[i]);
  return f.scaled && !cloud.areas.empty() ? T(weight + f.area_growth.dot(cloud.areas[i].template cast<T>())) : weight;
}

// Makes room for more points.
template <class T>
void grow(CandidatePoints<T>& candidates, bool elastic) {
  candidates.capacity = std::max(64, 2 * candidates.capacity);
  const std::size_t size = static_cast<std::size_t>(candidates.capacity) + PointCloud::padding;
  candidates.index.resize(size);
  for (auto* values : {&candidates.x, &candidates.y, &candidates.z, &candidates.weight}) values->resize(size);
  if (!elastic) return;
  for (auto* values : {&candidates.anchor_x, &candidates.anchor_y, &candidates.anchor_z, &candidates.has_anchor})
    values->resize(size);
}

// Whether a point that is now nearer to the shape than `margin` was found by that search.
template <class T>
bool covers(const BroadPhaseQuery<T>& query, const PairFrame<T>& f, const PointCloud& cloud, double margin) {
  const double rotated = real_part((f.rotation - query.rotation).squaredNorm());
  const double moved = real_part((f.offset - query.offset).squaredNorm());
  return std::sqrt(rotated) * cloud.extent + std::sqrt(moved) + margin <= query.margin;
}

// Finds the points that next steps look among, and this one, which needs those within `margin`.
template <class T>
void find_neighbors(const PairFrame<T>& f, const PointCloud& cloud, const T& reach, double margin,
                    CandidatePoints<T>& candidates) {
  candidates.neighbor_query = {f.rotation, f.offset, std::max(cloud.spacing / 2, margin)};
  candidates.neighbors.clear();
  for_candidate_points<T>(f, cloud, reach + T(candidates.neighbor_query.margin),
                          [&](int i) { candidates.neighbors.push_back(i); });
  const std::size_t size = candidates.neighbors.size() + PointCloud::padding;
  for (auto* values : {&candidates.neighbor_x, &candidates.neighbor_y, &candidates.neighbor_z}) values->resize(size);
  for (std::size_t n = 0; n < candidates.neighbors.size(); ++n) {
    const int i = candidates.neighbors[n];
    candidates.neighbor_x[n] = cloud.points.x[i];
    candidates.neighbor_y[n] = cloud.points.y[i];
    candidates.neighbor_z[n] = cloud.points.z[i];
  }
}

// Finds the points that may touch in one step of Newton's method: once, with a margin for what its iterations move, and
// another time only where that did not suffice. It looks among those that were within a wider margin at an earlier step,
// as long as nothing has moved farther since: what it finds does not depend on that.
template <class T>
void find_candidate_points(const PairFrame<T>& f, const PointCloud& cloud, const ContactSettings<T>& settings,
                           CacheState cache, CandidatePoints<T>& candidates) {
  const bool brute_force = cloud.size() <= PointCloud::brute_force_size;  // not worth a search: all of them
  double margin = cloud.spacing / 16;
  if (cache == CacheState::current) {
    if (brute_force || covers(candidates.query, f, cloud, 0)) return;
    margin = 4 * candidates.query.margin;
  }
  candidates.query = {f.rotation, f.offset, margin};
  const bool elastic = settings.law == FrictionLaw::elastic;
  if (candidates.capacity == 0) grow(candidates, elastic);
  const T reach = settings.rolling_radius + T(margin);
  int count = 0;
  const auto add = [&](int i, const T& x, const T& y, const T& z) {
    if (count == candidates.capacity) grow(candidates, elastic);
    candidates.index[count] = i;
    candidates.x[count] = x;
    candidates.y[count] = y;
    candidates.z[count] = z;
    ++count;
  };
  const PointCloud::Coordinates& points = cloud.points;
  const auto add_from_cloud = [&](int i) { add(i, T(points.x[i]), T(points.y[i]), T(points.z[i])); };
  if (brute_force) {
    for (int i = 0; i < cloud.size(); ++i) add_from_cloud(i);
  } else if constexpr (std::is_floating_point_v<T>) {
    if (cache == CacheState::stale || !covers(candidates.neighbor_query, f, cloud, margin)) {
      find_neighbors<T>(f, cloud, settings.rolling_radius, margin, candidates);
    }
    const int neighbor_count = static_cast<int>(candidates.neighbors.size());
    for_points_in_reach<T>(f, candidates.neighbor_x.data(), candidates.neighbor_y.data(), candidates.neighbor_z.data(),
                           0, neighbor_count, reach, [&](int n) {
                             add(candidates.neighbors[n], T(candidates.neighbor_x[n]), T(candidates.neighbor_y[n]),
                                 T(candidates.neighbor_z[n]));
                           });
  } else {
    for_candidate_points<T>(f, cloud, reach, add_from_cloud);
  }
  candidates.count = count;
  for (; count % pack_width<T> != 0; ++count) {  // what fills the last pack
    candidates.x[count] = candidates.y[count] = candidates.z[count] = T(0);
  }
  const int* const index = candidates.index.data();
  const auto gather = [&](std::vector<T>& to, auto&& number) {
    T* out = to.data();
    for (int n = 0; n < candidates.count; ++n) out[n] = number(index[n]);
    for (int n = candidates.count; n < count; ++n) out[n] = T(0);
  };
  gather(candidates.weight, [&](int i) { return scaled_weight(f, cloud, i); });
  if (!elastic) return;
  // An anchor that is not set may be anything; nothing looks at it.
  gather(candidates.anchor_x, [&](int i) { return settings.anchors[i][0]; });
  gather(candidates.anchor_y, [&](int i) { return settings.anchors[i][1]; });
  gather(candidates.anchor_z, [&](int i) { return settings.anchors[i][2]; });
  gather(candidates.has_anchor, [&](int i) { return T(settings.anchored[i] != 0 ? 1 : 0); });
}

}  // namespace gelflow
