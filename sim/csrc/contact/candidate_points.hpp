// The candidate contact points of a step: the result of the broad phase with a margin, kept while it covers the motion.
#pragma once

#include "contact/contact_settings.hpp"
#include "geometry/broad_phase.hpp"

namespace gelflow {

// Weight of a point at the scale of its body; areas scale with the faces that they lie on.
template <class T>
GELFLOW_INLINE T scaled_weight(const PairFrame<T>& f, const PointCloud& cloud, int i) {
  const T weight(cloud.weights[i]);
  return f.scaled && !cloud.areas.empty() ? T(weight + f.area_growth.dot(cloud.areas[i].template cast<T>())) : weight;
}

// Memory for more candidates, at first for all points of a small cloud: many small contacts then share cache lines.
template <class T>
void grow(CandidatePoints<T>& c, const PointCloud& cloud, bool elastic) {
  c.capacity = std::max(std::min(64, cloud.size()), 2 * c.capacity);
  const std::size_t size = static_cast<std::size_t>(c.capacity) + PointCloud::padding;
  c.index.resize(size);
  for (auto* values : {&c.x, &c.y, &c.z, &c.weight}) values->resize(size);
  if (!elastic) return;
  for (auto* values : {&c.anchor_x, &c.anchor_y, &c.anchor_z, &c.has_anchor}) values->resize(size);
  c.active_packs.resize(size / pack_width<T> + 1);
}

// Whether the query contains every point that is now within `margin` of the shape: no point has moved farther than the
// difference of the margins.
template <class T>
bool covers(const BroadPhaseQuery<T>& query, const PairFrame<T>& f, const PointCloud& cloud, double margin) {
  const double rotated = real_part((f.rotation - query.rotation).squaredNorm());
  const double moved = real_part((f.offset - query.offset).squaredNorm());
  return std::sqrt(rotated) * cloud.extent + std::sqrt(moved) + margin <= query.margin;
}

// Updates the neighbor list (Verlet list): the points within a wider margin, which serves several steps.
template <class T>
void find_neighbors(const PairFrame<T>& f, const PointCloud& cloud, const T& reach, double margin,
                    CandidatePoints<T>& c) {
  c.neighbor_query = {f.rotation, f.offset, std::max(cloud.spacing / 2, margin)};
  c.neighbors.clear();
  for_candidate_points<T>(f, cloud, reach + T(c.neighbor_query.margin), [&](int i) { c.neighbors.push_back(i); });
  const std::size_t size = c.neighbors.size() + PointCloud::padding;
  for (auto* values : {&c.neighbor_x, &c.neighbor_y, &c.neighbor_z}) values->resize(size);
  for (std::size_t n = 0; n < c.neighbors.size(); ++n) {
    const int i = c.neighbors[n];
    c.neighbor_x[n] = cloud.points.x[i];
    c.neighbor_y[n] = cloud.points.y[i];
    c.neighbor_z[n] = cloud.points.z[i];
  }
}

// Sets index and coordinates of the candidates within `reach` of the shape and returns their number.
template <class T>
GELFLOW_INLINE int select_candidates(const PairFrame<T>& f, const PointCloud& cloud, const T& reach, bool elastic,
                                     bool brute_force, CandidatePoints<T>& c) {
  int count = 0;
  const auto add = [&](int i, const T& x, const T& y, const T& z) {
    if (count == c.capacity) grow(c, cloud, elastic);
    c.index[count] = i;
    c.x[count] = x;
    c.y[count] = y;
    c.z[count] = z;
    ++count;
  };
  const PointCloud::Coordinates& points = cloud.points;
  const auto add_from_cloud = [&](int i) { add(i, T(points.x[i]), T(points.y[i]), T(points.z[i])); };
  if (brute_force) {
    for (int i = 0; i < cloud.size(); ++i) add_from_cloud(i);
  } else if constexpr (std::is_floating_point_v<T>) {
    const int neighbor_count = static_cast<int>(c.neighbors.size());
    for_points_in_reach<T>(
        f, c.neighbor_x.data(), c.neighbor_y.data(), c.neighbor_z.data(), 0, neighbor_count, reach,
        [&](int n) { add(c.neighbors[n], T(c.neighbor_x[n]), T(c.neighbor_y[n]), T(c.neighbor_z[n])); });
  } else {
    for_candidate_points<T>(f, cloud, reach, add_from_cloud);
  }
  return count;
}

// Copies weights and anchors of the candidates and fills the last pack with zeros.
template <class T>
GELFLOW_INLINE void gather_point_data(const PairFrame<T>& f, const PointCloud& cloud,
                                      const ContactSettings<T>& settings, CandidatePoints<T>& c) {
  int padded = c.count;
  for (; padded % pack_width<T> != 0; ++padded) c.x[padded] = c.y[padded] = c.z[padded] = T(0);
  const int* const index = c.index.data();
  const auto gather = [&](std::vector<T>& to, auto&& value) {
    T* out = to.data();
    for (int n = 0; n < c.count; ++n) out[n] = value(index[n]);
    for (int n = c.count; n < padded; ++n) out[n] = T(0);
  };
  gather(c.weight, [&](int i) { return scaled_weight(f, cloud, i); });
  if (settings.law != FrictionLaw::elastic) return;
  // An anchor that is not set may have any value: it is masked.
  gather(c.anchor_x, [&](int i) { return settings.anchors[i][0]; });
  gather(c.anchor_y, [&](int i) { return settings.anchors[i][1]; });
  gather(c.anchor_z, [&](int i) { return settings.anchors[i][2]; });
  gather(c.has_anchor, [&](int i) { return T(settings.anchored[i] != 0 ? 1 : 0); });
}

// Finds the points that may touch the shape during one solve of Newton's method. The margin covers the motion of its
// iterations; where that does not suffice, the search is repeated with a larger one. The points come from the neighbor
// list while it covers them, so the result does not depend on earlier steps.
template <class T>
void find_candidate_points(const PairFrame<T>& f, const PointCloud& cloud, const ContactSettings<T>& settings,
                           CacheState cache, CandidatePoints<T>& c) {
  const bool brute_force = cloud.size() <= PointCloud::brute_force_size;
  double margin = cloud.spacing / 16;
  if (cache == CacheState::current) {
    if (brute_force || covers(c.query, f, cloud, 0)) return;
    margin = 4 * c.query.margin;
  }
  c.query = {f.rotation, f.offset, margin};
  const bool elastic = settings.law == FrictionLaw::elastic;
  if (c.capacity == 0) grow(c, cloud, elastic);
  if constexpr (std::is_floating_point_v<T>) {
    if (!brute_force && (cache == CacheState::stale || !covers(c.neighbor_query, f, cloud, margin))) {
      find_neighbors<T>(f, cloud, settings.rolling_radius, margin, c);
    }
  }
  c.count = select_candidates<T>(f, cloud, settings.rolling_radius + T(margin), elastic, brute_force, c);
  gather_point_data<T>(f, cloud, settings, c);
}

}  // namespace gelflow
