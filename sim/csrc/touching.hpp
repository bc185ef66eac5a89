// Points that touch a shape, a pack at a time; and the memory of the elastic law.
#pragma once

#include "near_points.hpp"

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
  Vec3<L> anchor, e;
  Mask<L> remembers;  // has an anchor

  template <class F>
  GELFLOW_INLINE void for_each_inside(F&& f) const {
    for (unsigned left = bits(inside); left != 0; left &= left - 1) {
      const int k = std::countr_zero(left);
      f(k, index != nullptr ? index[k] : first + k);
    }
  }
};

// Looks at points with these places in the first body's frame, of which t knows the anchors. Whether any is inside.
// `curved`: Hessians of the distance are asked for.
template <bool curved, class T>
GELFLOW_INLINE bool touches(const PairFrame<T>& frame, const TouchRule<T>& rule, const Vec3<Pack<T>>& local,
                            const Pack<T>& weight, Touching<T>& t) {
  using L = Pack<T>;
  t.x = t.center = spread<L>(frame.rotation) * local + spread<L>(frame.offset);
  if (rule.rolling_radius > T(0)) t.x.z -= L(rule.rolling_radius);  // planes only: n = z
  distance<curved>(frame.kind, frame.size, frame.grid, t.x, t.at);
  t.inside = t.at.d < L(0.0) && weight > L(0.0);
  if (!any(t.inside)) return false;
  const T* p = rule.params;
  const L felt = select(t.inside, weight, L(0.0)), share = L(T(rule.softness)) * felt;
  t.law.kn = felt * L(p[0]);
  t.law.kt = share * L(p[1]);
  t.law.mu = L(p[2]);
  t.law.kd = felt * L(p[3]);
  t.law.damping = rule.damping;
  t.law.elastic = rule.law == FrictionLaw::elastic;
  t.v = spread<L>(frame.linear) + cross(spread<L>(frame.angular), t.x);
  if (t.law.elastic) {
    t.law.ks = share * L(p[4]);
    const L size = abs(t.x.x) + abs(t.x.y) + abs(t.x.z);
    t.law.rounding = L(T(4 * real_part(Eigen::NumTraits<T>::epsilon()))) * size;
    t.e = select3<L>(t.remembers, t.x - t.anchor, zero3<L>());
  }
  return true;
}

// Calls f(touching) for all points of a cloud that are inside the shape, a pack at a time.
template <bool curved, class T, class F>
void for_touching_points(const PairFrame<T>& frame, const PointCloud& cloud, const TouchRule<T>& rule, F&& f) {
  using L = Pack<T>;
  constexpr int width = pack_width<T>;
  const bool elastic = rule.law == FrictionLaw::elastic, weighs = frame.scaled && !cloud.areas.empty();
  int begin = 0, end = 0;  // a run of neighbouring leaves
  const auto look = [&] {
    for (int i = begin; i < end; i += width) {
      Touching<T> t;
      const int count = std::min(width, end - i);
      const Vec3<L> local{load<L>(&cloud.points.x[i]), load<L>(&cloud.points.y[i]), load<L>(&cloud.points.z[i])};
      L weight = select(first_lanes<L>(count), load<L>(&cloud.weights[i]), L(0.0));
      if (weighs) {
        T weights[width] = {};
        for (int k = 0; k < count; ++k) weights[k] = scaled_weight(frame, cloud, i + k);
        weight = load<L>(weights);
      }
      t.anchor = zero3<L>();
      t.remembers = first_lanes<L>(0);
      if (elastic) {
        T anchors[3][width] = {}, remembers[width] = {};
        for (int k = 0; k < count; ++k) {
          if (!rule.anchored[i + k]) continue;
          for (int a = 0; a < 3; ++a) anchors[a][k] = rule.anchors[i + k][a];
          remembers[k] = T(1);
        }
        t.anchor = {load<L>(anchors[0]), load<L>(anchors[1]), load<L>(anchors[2])};
        t.remembers = load<L>(remembers) > L(0.0);
      }
      t.first = i;
      if (touches<curved, T>(frame, rule, local, weight, t)) f(static_cast<const Touching<T>&>(t));
    }
  };
  for_near_leaves<T>(frame, cloud, rule.rolling_radius, [&](int from, int to) {
    if (from != end) {
      look();
      begin = from;
    }
    end = to;
  });
  look();
}

// The same for points that were found near.
template <bool curved, class T, class F>
GELFLOW_INLINE void for_touching_points(const PairFrame<T>& frame, const NearPoints<T>& near, const TouchRule<T>& rule,
                                        F&& f) {
  using L = Pack<T>;
  const bool elastic = rule.law == FrictionLaw::elastic;
  for (int i = 0; i < near.count; i += pack_width<T>) {
    Touching<T> t;
    t.anchor = zero3<L>();
    t.remembers = first_lanes<L>(0);
    if (elastic) {
      t.anchor = {load<L>(&near.anchor_x[i]), load<L>(&near.anchor_y[i]), load<L>(&near.anchor_z[i])};
      t.remembers = load<L>(&near.remembers[i]) > L(0.0);
    }
    t.index = &near.index[i];
    const Vec3<L> local{load<L>(&near.x[i]), load<L>(&near.y[i]), load<L>(&near.z[i])};
    if (touches<curved, T>(frame, rule, local, load<L>(&near.weight[i]), t)) f(static_cast<const Touching<T>&>(t));
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
