// Points that touch a shape, a pack at a time; and the memory of the elastic law.
#pragma once

#include "geometry/broad_phase.hpp"

namespace gelflow {

// Points that are looked at together; `inside` tells which of them touch.
template <class T>
struct Touching {
  using L = Pack<T>;
  int first = 0;               // index of the first one in the cloud, the others follow;
  const int* index = nullptr;  // or of all of them
  Mask<L> inside;
  PointLaw<L> law;  // of weight 0 where a point does not touch
  Distance<L> at;
  Vec3<L> center, x;  // the point itself, or the centre of a rolling sphere; the point that touches
  Vec3<L> v;          // relative to the shape
  Mask<L> remembers;  // has an anchor
  Vec3<L> anchor, e;  // elastic law

  template <class F>
  GELFLOW_INLINE void for_each_inside(F&& f) const {
    for (unsigned left = bits(inside); left != 0; left &= left - 1) {
      const int k = std::countr_zero(left);
      f(k, index != nullptr ? index[k] : first + k);
    }
  }
};

// What is the same for all points of a pair, spread over packs.
template <class T>
struct PairConstants {
  using L = Pack<T>;
  Mat3<L> rotation;
  Vec3<L> offset;  // to the point that touches: the lowest one of a rolling sphere, which only touches planes
  L lift;          // from there to the sphere's centre
  Vec3<L> angular, linear;
  L kn, kt, mu, kd, ks, rounding;
  DampingLaw damping;
  bool elastic;

  PairConstants(const PairFrame<T>& frame, const TouchRule<T>& rule)
      : rotation(spread<L>(frame.rotation)),
        offset(spread<L>(V3<T>(frame.offset - V3<T>(T(0), T(0), rule.rolling_radius)))),
        lift(rule.rolling_radius),
        angular(spread<L>(frame.angular)),
        linear(spread<L>(frame.linear)),
        kn(rule.params[0]),
        kt(T(T(rule.softness) * rule.params[1])),
        mu(rule.params[2]),
        kd(rule.params[3]),
        ks(T(T(rule.softness) * rule.params[4])),
        rounding(T(4 * real_part(Eigen::NumTraits<T>::epsilon()))),
        damping(rule.damping),
        elastic(rule.law == FrictionLaw::elastic) {}

  GELFLOW_INLINE Vec3<L> place(const Vec3<L>& local) const {
    const auto along = [&](int a) GELFLOW_LOOP_BODY {
      const Vec3<L>& row = rotation.row[a];
      return offset[a] + row.x * local.x + row.y * local.y + row.z * local.z;
    };
    return {along(0), along(1), along(2)};
  }
  GELFLOW_INLINE Vec3<L> velocity(const Vec3<L>& x) const {
    return {linear.x + angular.y * x.z - angular.z * x.y, linear.y + angular.z * x.x - angular.x * x.z,
            linear.z + angular.x * x.y - angular.y * x.x};
  }
};

// What points feel of which t knows the places, the distances and the anchors; `felt`: their weights, 0 where one does
// not touch.
template <bool elastic, class T>
GELFLOW_INLINE void feel(const PairConstants<T>& pair, const Pack<T>& felt, Touching<T>& t) {
  t.law.kn = felt * pair.kn;
  t.law.kt = felt * pair.kt;
  t.law.mu = pair.mu;
  t.law.kd = felt * pair.kd;
  t.law.damping = pair.damping;
  t.law.elastic = elastic;
  t.v = pair.velocity(t.x);
  if constexpr (elastic) {
    t.law.ks = felt * pair.ks;
    t.law.rounding = pair.rounding * (abs(t.x.x) + abs(t.x.y) + abs(t.x.z));
    t.e = select3<Pack<T>>(t.remembers, t.x - t.anchor, zero3<Pack<T>>());
  }
}

// Runs of neighbouring leaves that may touch, in the order of the cloud.
struct NearRuns {
  std::vector<std::pair<int, int>> runs;  // begin, end
  int points = 0;
};
// They are this thread's own, and made anew by the next call.
template <class T>
const NearRuns& near_runs(const PairFrame<T>& frame, const PointCloud& cloud, const T& reach) {
  thread_local NearRuns own;
  NearRuns& near = own;  // asked for once
  near.runs.clear();
  near.points = 0;
  for_near_leaves<T>(frame, cloud, reach, [&](int begin, int end) {
    near.points += end - begin;
    if (!near.runs.empty() && near.runs.back().second == begin) {
      near.runs.back().second = end;
    } else {
      near.runs.emplace_back(begin, end);
    }
  });
  return near;
}

// The points of a cloud in a precision; behind the last stand zeros.
template <class T>
struct Listed {
  const double *x, *y, *z, *weights;
  explicit Listed(const PointCloud& c)
      : x(c.points.x.data()), y(c.points.y.data()), z(c.points.z.data()), weights(c.weights.data()) {}
};
template <>
struct Listed<float> {
  const float *x, *y, *z, *weights;
  explicit Listed(const PointCloud& c)
      : x(c.rounded.x.data()), y(c.rounded.y.data()), z(c.rounded.z.data()), weights(c.rounded.weights.data()) {}
};

// Calls f(touching) for all points of these runs that are inside the shape, a pack at a time, and skipped(begin, end) for
// those between and around, in the order of the cloud. Some packs are placed before the first of them is felt: two short
// loops that keep their constants at hand, of which a processor works at several rounds at once.
template <bool curved, bool elastic, class T, class F, class Skipped>
GELFLOW_INLINE void for_touching_points(const PairFrame<T>& frame, const PointCloud& cloud, const NearRuns& near,
                                        const TouchRule<T>& rule, F&& f, Skipped&& skipped) {
  using L = Pack<T>;
  constexpr int width = pack_width<T>, most = 16;
  struct Placed {
    Vec3<L> x, n;
    L d, felt;  // felt: weight where it touches, else 0
  };
  Placed placed[most];
  struct Bent {  // of which just what a shape has is written
    L bow;
    Mat3<L> hessian;
  };
  Bent bent[curved ? most : 1];
  Bend bend{};
  const PairConstants<T> pair(frame, rule);
  const bool weighs = frame.scaled && !cloud.areas.empty();
  const Listed<T> listed(cloud);
  const auto place = [&](int begin, int end) GELFLOW_LOOP_BODY {
    with_distance<curved, L, T>(frame.kind, frame.size, frame.grid, [&](auto&& of) GELFLOW_LOOP_BODY {
      for (int i = begin, n = 0; i < end; i += width, ++n) {
        Placed& p = placed[n];
        Distance<L> at;
        const Vec3<L> x = pair.place({load<L>(listed.x + i), load<L>(listed.y + i), load<L>(listed.z + i)});
        p.x.x = x.x, p.x.y = x.y, p.x.z = x.z;  // one by one they stay in registers
        of(x, at);
        p.d = at.d;
        p.n.x = at.n.x, p.n.y = at.n.y, p.n.z = at.n.z;
        p.felt = select(at.d < L(0.0), load<L>(listed.weights + i), L(0.0));
        bend = at.bend;
        if constexpr (curved) {
          if (at.bend == Bend::round) {
            bent[n].bow = at.bow;
          } else if (at.bend != Bend::flat) {
            bent[n].hessian = at.hessian;
          }
        }
      }
    });
    for (int i = begin; weighs && i < std::min(end, cloud.size()); ++i) {
      Placed& p = placed[(i - begin) / width];
      const int k = (i - begin) % width;
      if (lane(p.felt, k) > T(0)) set_lane(p.felt, k, scaled_weight(frame, cloud, i));
    }
  };
  const auto look = [&](int i, int n) GELFLOW_LOOP_BODY {
    const Placed& p = placed[n];
    Touching<T> t;
    t.inside = p.felt > L(0.0);
    if (!any(t.inside)) return skipped(i, std::min(i + width, cloud.size()));
    t.remembers = first_lanes<L>(0);
    if constexpr (elastic) {
      T anchors[3][width] = {}, remembers[width] = {};
      for (int k = 0; k < width && i + k < cloud.size(); ++k) {
        if (!rule.anchored[i + k]) continue;
        for (int a = 0; a < 3; ++a) anchors[a][k] = rule.anchors[i + k][a];
        remembers[k] = T(1);
      }
      t.anchor = {load<L>(anchors[0]), load<L>(anchors[1]), load<L>(anchors[2])};
      t.remembers = load<L>(remembers) > L(0.0);
    }
    t.first = i;
    t.x = p.x;
    t.center = {p.x.x, p.x.y, p.x.z + pair.lift};
    t.at.d = p.d;
    t.at.n = p.n;
    t.at.bend = bend;
    if constexpr (curved) {
      if (bend == Bend::round) {
        t.at.bow = bent[n].bow;
      } else if (bend != Bend::flat) {
        t.at.hessian = bent[n].hessian;
      }
    }
    feel<elastic, T>(pair, p.felt, t);
    f(static_cast<const Touching<T>&>(t));
  };
  int seen = 0;
  for (const auto& [first, last] : near.runs) {
    skipped(seen, first);
    seen = last;
    for (int begin = first; begin < last; begin += most * width) {
      const int end = std::min(begin + most * width, last);
      place(begin, end);
      for (int i = begin, n = 0; i < end; i += width, ++n) look(i, n);
    }
  }
  skipped(seen, cloud.size());
}
template <bool curved, class T, class F, class Skipped>
GELFLOW_INLINE void for_touching_points(const PairFrame<T>& frame, const PointCloud& cloud, const NearRuns& near,
                                        const TouchRule<T>& rule, F&& f, Skipped&& skipped) {
  if (rule.law == FrictionLaw::elastic) {
    for_touching_points<curved, true, T>(frame, cloud, near, rule, f, skipped);
  } else {
    for_touching_points<curved, false, T>(frame, cloud, near, rule, f, skipped);
  }
}
template <bool curved, class T, class F>
void for_touching_points(const PairFrame<T>& frame, const PointCloud& cloud, const TouchRule<T>& rule, F&& f) {
  for_touching_points<curved, T>(frame, cloud, near_runs<T>(frame, cloud, rule.rolling_radius), rule, f,
                                 [](int, int) {});
}

// The same for points that were found near.
template <bool curved, class T, class F>
GELFLOW_INLINE void for_touching_points(const PairFrame<T>& frame, const NearPoints<T>& near, const TouchRule<T>& rule,
                                        F&& f) {
  using L = Pack<T>;
  const PairConstants<T> pair(frame, rule);
  for (int i = 0; i < near.count; i += pack_width<T>) {
    const Vec3<L> local{load<L>(&near.x[i]), load<L>(&near.y[i]), load<L>(&near.z[i])};
    const L weight = load<L>(&near.weight[i]);
    Touching<T> t;
    t.x = pair.place(local);
    t.center = {t.x.x, t.x.y, t.x.z + pair.lift};
    distance<curved>(frame.kind, frame.size, frame.grid, t.x, t.at);
    t.inside = t.at.d < L(0.0) && weight > L(0.0);
    if (!any(t.inside)) continue;
    t.remembers = first_lanes<L>(0);
    if (pair.elastic) {
      t.anchor = {load<L>(&near.anchor_x[i]), load<L>(&near.anchor_y[i]), load<L>(&near.anchor_z[i])};
      t.remembers = load<L>(&near.remembers[i]) > L(0.0);
    }
    t.index = &near.index[i];
    if (pair.elastic) {
      feel<true, T>(pair, select(t.inside, weight, L(0.0)), t);
    } else {
      feel<false, T>(pair, select(t.inside, weight, L(0.0)), t);
    }
    f(static_cast<const Touching<T>&>(t));
  }
}

// The anchors of one cloud after an accepted step, of those points that were found near; `next` and `next_set` may be the
// arrays that were read for that.
template <class T>
void advance_anchors(const PairFrame<T>& frame, const NearPoints<T>& near, const TouchRule<T>& rule, int cloud_size,
                     V3<T>* next, std::uint8_t* next_set) {
  std::fill(next_set, next_set + cloud_size, 0);
  for_touching_points<false, T>(frame, near, rule, [&](const Touching<T>& t) GELFLOW_LOOP_BODY {
    PointForce<Pack<T>> force;
    point_force<false>(t.law, t.at, t.v, t.e, t.remembers, force);
    const Vec3<Pack<T>> anchor = next_anchor(t.law, Pack<T>(rule.h), force, t.x, t.anchor, t.remembers);
    t.for_each_inside([&](int k, int i) {
      next[i] = lane3<T>(anchor, k);
      next_set[i] = 1;
    });
  });
}

// The reverse of `advance_anchors`: gradients of the anchors after the step go to the relative pose and twist and to the
// anchors before.
template <class T, class Points>
void anchors_transposed(const PairFrame<T>& frame, const Points& points, const TouchRule<T>& rule, const V3<T>* by_next,
                        V6<T>& by_pose, V6<T>& by_twist, V3<T>* by_anchor) {
  using L = Pack<T>;
  Vec3<L> turn = zero3<L>(), shift = turn, spin = turn, slide = turn;
  for_touching_points<true, T>(frame, points, rule, [&](const Touching<T>& t) {
    Vec3<L> lambda = zero3<L>();
    t.for_each_inside([&](int k, int i) { set_lane3<T>(lambda, k, by_next[i]); });
    const PointGradient<L> g = next_anchor_transposed(t.law, L(rule.h), t.at, t.v, t.e, t.remembers, lambda);
    const Vec3<L> by_point = g.x - cross(spread<L>(frame.angular), g.v);
    turn += cross(t.center, by_point);
    shift += by_point;
    spin += cross(t.x, g.v);
    slide += g.v;
    t.for_each_inside([&](int k, int i) {
      if (is_set(t.remembers, k)) by_anchor[i] += lane3<T>(g.anchor, k);
    });
  });
  by_pose += stack<T>(sum3<T>(turn), sum3<T>(shift));
  by_twist += stack<T>(sum3<T>(spin), sum3<T>(slide));
}

}  // namespace gelflow
