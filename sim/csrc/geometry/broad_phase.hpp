// Which points of a cloud may touch a shape.
#pragma once

#include <bit>

#include "contact/pair_frame.hpp"

namespace gelflow {

constexpr double reach_slack = 1e-6;  // [m], above the rounding of single precision

// What the points of one cloud need besides their places.
template <class T>
struct TouchRule {
  const T* params;  // kn, kt, mu, kd, ks
  FrictionLaw law;
  DampingLaw damping;
  T rolling_radius;              // 0: the points themselves touch
  const V3<T>* anchors;          // of this cloud against this shape
  const std::uint8_t* anchored;  // both unused under the viscous law
  double softness = 1;           // share of k_t and k_s that is at work
  T h = T(0);                    // length of the step, where one is taken
};

// Calls visit(first, last) for runs of blocks, among from … to, that may reach into the shape grown by `margin`.
template <bool scaled, class T, class Visit>
GELFLOW_INLINE void for_near_blocks(const PairFrame<T>& f, const PointCloud::Blocks& blocks, int from, int to,
                                    const T& margin, Visit&& visit) {
  using L = Pack<T>;
  for (int b = from; b < to; b += pack_width<T>) {
    const Vec3<L> center{load<L>(&blocks.center.x[b]), load<L>(&blocks.center.y[b]), load<L>(&blocks.center.z[b])};
    const L radius = load<L>(&blocks.radius[b]);
    const L reach = (scaled ? L(f.stretch) * radius : radius) + L(margin);
    unsigned near = bits(f.template may_reach<scaled, L>(center, reach) && first_lanes<L>(to - b));
    while (near != 0) {
      const int first = std::countr_zero(near), count = std::countr_one(near >> first);
      visit(b + first, b + first + count);
      near &= ~0U << (first + count);
    }
  }
}

// Calls visit(begin, end) for neighbours in the cloud, some of which may be inside the shape grown by `margin`.
template <bool scaled, class T, class Visit>
GELFLOW_INLINE void for_near_leaves(const PairFrame<T>& f, const PointCloud& cloud, const T& margin, Visit&& visit) {
  const T around = margin + T(reach_slack);
  for_near_blocks<scaled, T>(f, cloud.groups, 0, cloud.groups.count(), around, [&](int first, int last) {
    for_near_blocks<scaled, T>(
        f, cloud.leaves, cloud.groups.begin[first], cloud.groups.end[last - 1], around,
        [&](int begin, int end) { visit(cloud.leaves.begin[begin], cloud.leaves.end[end - 1]); });
  });
}

// What is near is no matter of derivatives: the frame of a run whose numbers carry some.
template <class T>
PairFrame<double> real_frame(const PairFrame<T>& f, double* size) {
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
  real.stretch = f.scaled ? real_part(f.stretch) : 1.0;
  real.local_level = real_part(f.local_level);
  return real;
}

template <class T, class Visit>
GELFLOW_INLINE void for_near_leaves(const PairFrame<T>& f, const PointCloud& cloud, const T& margin, Visit&& visit) {
  if constexpr (std::is_floating_point_v<T>) {
    if (f.scaled) return for_near_leaves<true, T>(f, cloud, margin, visit);
    return for_near_leaves<false, T>(f, cloud, margin, visit);
  } else {
    double size[3];
    for_near_leaves<true, double>(real_frame(f, size), cloud, real_part(margin), visit);
  }
}

// Calls visit(i) for those of the points begin … end that may be nearer to the shape than `reach`.
template <class T, class Visit>
GELFLOW_INLINE void for_reaching(const PairFrame<T>& f, const double* x, const double* y, const double* z, int begin,
                                 int end, const T& reach, Visit&& visit) {
  using L = Pack<T>;
  const L around = L(reach + T(reach_slack));
  for (int i = begin; i < end; i += pack_width<T>) {
    const Vec3<L> point{load<L>(x + i), load<L>(y + i), load<L>(z + i)};
    const Mask<L> reaches =
        f.scaled ? f.template may_reach<true, L>(point, around) : f.template may_reach<false, L>(point, around);
    unsigned near = bits(reaches && first_lanes<L>(end - i));
    for (; near != 0; near &= near - 1) visit(i + std::countr_zero(near));
  }
}

// The same for all points of a cloud.
template <class T, class Visit>
void for_near_points(const PairFrame<T>& f, const PointCloud& cloud, const T& reach, Visit&& visit) {
  if constexpr (std::is_floating_point_v<T>) {
    const PointCloud::Places& p = cloud.points;
    for_near_leaves<T>(f, cloud, reach, [&](int begin, int end) {
      for_reaching<T>(f, p.x.data(), p.y.data(), p.z.data(), begin, end, reach, visit);
    });
  } else {
    double size[3];
    for_near_points<double>(real_frame(f, size), cloud, real_part(reach), visit);
  }
}

// The weights of points, scaled with their body: `weight` is that of the scale 1.
template <class T>
GELFLOW_INLINE T scaled_weight(const PairFrame<T>& f, const PointCloud& cloud, int i) {
  const T weight(cloud.weights[i]);
  return f.scaled && !cloud.areas.empty() ? T(weight + f.enlarged.dot(cloud.areas[i].template cast<T>())) : weight;
}

// Makes room for more points.
template <class T>
void grow(NearPoints<T>& near, bool elastic) {
  near.capacity = std::max(64, 2 * near.capacity);
  const std::size_t size = static_cast<std::size_t>(near.capacity) + PointCloud::padding;
  near.index.resize(size);
  for (auto* values : {&near.x, &near.y, &near.z, &near.weight}) values->resize(size);
  if (!elastic) return;
  for (auto* values : {&near.anchor_x, &near.anchor_y, &near.anchor_z, &near.remembers}) values->resize(size);
}

// Whether a point that is now nearer to the shape than `margin` was found by that search.
template <class T>
bool covers(const Search<T>& search, const PairFrame<T>& f, const PointCloud& cloud, double margin) {
  const double turned = real_part((f.rotation - search.rotation).squaredNorm());
  const double moved = real_part((f.offset - search.offset).squaredNorm());
  return std::sqrt(turned) * cloud.extent + std::sqrt(moved) + margin <= search.margin;
}

// Finds the points that next steps look among, and this one, which needs those within `margin`.
template <class T>
void find_around(const PairFrame<T>& f, const PointCloud& cloud, const T& reach, double margin, NearPoints<T>& near) {
  near.wide = {f.rotation, f.offset, std::max(cloud.spacing / 2, margin)};
  near.around.clear();
  for_near_points<T>(f, cloud, reach + T(near.wide.margin), [&](int i) { near.around.push_back(i); });
  const std::size_t size = near.around.size() + PointCloud::padding;
  for (auto* values : {&near.around_x, &near.around_y, &near.around_z}) values->resize(size);
  for (std::size_t n = 0; n < near.around.size(); ++n) {
    const int i = near.around[n];
    near.around_x[n] = cloud.points.x[i];
    near.around_y[n] = cloud.points.y[i];
    near.around_z[n] = cloud.points.z[i];
  }
}

// Finds the points that may touch in one step of Newton's method: once, with a margin for what its iterations move, and
// another time only where that did not suffice. It looks among those that were within a wider margin at an earlier step,
// as long as nothing has moved farther since: what it finds does not depend on that.
template <class T>
void find_near_points(const PairFrame<T>& f, const PointCloud& cloud, const TouchRule<T>& rule, Found found,
                      NearPoints<T>& near) {
  const bool few = cloud.size() <= PointCloud::few;  // not worth a search: all of them
  double margin = cloud.spacing / 16;
  if (found == Found::now) {
    if (few || covers(near.search, f, cloud, 0)) return;
    margin = 4 * near.search.margin;
  }
  near.search = {f.rotation, f.offset, margin};
  const bool elastic = rule.law == FrictionLaw::elastic;
  if (near.capacity == 0) grow(near, elastic);
  const T reach = rule.rolling_radius + T(margin);
  int count = 0;
  const auto add = [&](int i, const T& x, const T& y, const T& z) {
    if (count == near.capacity) grow(near, elastic);
    near.index[count] = i;
    near.x[count] = x;
    near.y[count] = y;
    near.z[count] = z;
    ++count;
  };
  const PointCloud::Places& points = cloud.points;
  const auto add_own = [&](int i) { add(i, T(points.x[i]), T(points.y[i]), T(points.z[i])); };
  if (few) {
    for (int i = 0; i < cloud.size(); ++i) add_own(i);
  } else if constexpr (std::is_floating_point_v<T>) {
    if (found == Found::elsewhere || !covers(near.wide, f, cloud, margin)) {
      find_around<T>(f, cloud, rule.rolling_radius, margin, near);
    }
    const int among = static_cast<int>(near.around.size());
    for_reaching<T>(f, near.around_x.data(), near.around_y.data(), near.around_z.data(), 0, among, reach,
                    [&](int n) { add(near.around[n], T(near.around_x[n]), T(near.around_y[n]), T(near.around_z[n])); });
  } else {
    for_near_points<T>(f, cloud, reach, add_own);
  }
  near.count = count;
  for (; count % pack_width<T> != 0; ++count) {  // what fills the last pack
    near.x[count] = near.y[count] = near.z[count] = T(0);
  }
  const int* const index = near.index.data();
  const auto gather = [&](std::vector<T>& to, auto&& number) {
    T* out = to.data();
    for (int n = 0; n < near.count; ++n) out[n] = number(index[n]);
    for (int n = near.count; n < count; ++n) out[n] = T(0);
  };
  gather(near.weight, [&](int i) { return scaled_weight(f, cloud, i); });
  if (!elastic) return;
  // An anchor that is not set may be anything; nothing looks at it.
  gather(near.anchor_x, [&](int i) { return rule.anchors[i][0]; });
  gather(near.anchor_y, [&](int i) { return rule.anchors[i][1]; });
  gather(near.anchor_z, [&](int i) { return rule.anchors[i][2]; });
  gather(near.remembers, [&](int i) { return T(rule.anchored[i] != 0 ? 1 : 0); });
}

}  // namespace gelflow
