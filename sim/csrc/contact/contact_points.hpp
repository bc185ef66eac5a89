// Points that touch a shape, a pack at a time; and the memory of the elastic law.
#pragma once

#include "geometry/broad_phase.hpp"

namespace gelflow {

// Points that are looked at together; `inside` tells which of them touch.
template <class T>
struct ContactPack {
  using P = Pack<T>;
  int first = 0;               // index of the first one in the cloud, the others follow;
  const int* index = nullptr;  // or of all of them
  Mask<P> active;
  PointLaw<P> law;  // of weight 0 where a point does not touch
  Distance<P> at;
  Vec3<P> center, x;   // the point itself, or the centre of a rolling sphere; the point that touches
  Vec3<P> v;           // relative to the shape
  Mask<P> has_anchor;  // has an anchor
  Vec3<P> anchor, e;   // elastic law

  template <class F>
  GELFLOW_INLINE void for_each_active(F&& f) const {
    for (unsigned remaining = bits(active); remaining != 0; remaining &= remaining - 1) {
      const int k = std::countr_zero(remaining);
      f(k, index != nullptr ? index[k] : first + k);
    }
  }
};

// What is the same for all points of a pair, spread over packs.
template <class T>
struct PairConstants {
  using P = Pack<T>;
  Mat3<P> rotation;
  Vec3<P> offset;   // to the point that touches: the lowest one of a rolling sphere, which only touches planes
  P center_height;  // from there to the sphere's centre
  Vec3<P> angular, linear;
  P kn, kt, mu, kd, ks, rounding;
  DampingLaw damping;
  bool elastic;

  PairConstants(const PairFrame<T>& frame, const ContactSettings<T>& settings)
      : rotation(broadcast<P>(frame.rotation)),
        offset(broadcast<P>(V3<T>(frame.offset - V3<T>(T(0), T(0), settings.rolling_radius)))),
        center_height(settings.rolling_radius),
        angular(broadcast<P>(frame.angular)),
        linear(broadcast<P>(frame.linear)),
        kn(settings.params[0]),
        kt(T(T(settings.continuation) * settings.params[1])),
        mu(settings.params[2]),
        kd(settings.params[3]),
        ks(T(T(settings.continuation) * settings.params[4])),
        rounding(T(4 * real_part(Eigen::NumTraits<T>::epsilon()))),
        damping(settings.damping),
        elastic(settings.law == FrictionLaw::elastic) {}

  GELFLOW_INLINE Vec3<P> to_shape_frame(const Vec3<P>& local) const {
    const auto along = [&](int a) GELFLOW_LOOP_BODY {
      const Vec3<P>& row = rotation.row[a];
      return offset[a] + row.x * local.x + row.y * local.y + row.z * local.z;
    };
    return {along(0), along(1), along(2)};
  }
  GELFLOW_INLINE Vec3<P> velocity(const Vec3<P>& x) const {
    return {linear.x + angular.y * x.z - angular.z * x.y, linear.y + angular.z * x.x - angular.x * x.z,
            linear.z + angular.x * x.y - angular.y * x.x};
  }
};

// What points feel of which t knows the places, the distances and the anchors; `felt`: their weights, 0 where one does
// not touch.
template <bool elastic, class T>
GELFLOW_INLINE void eval_contact(const PairConstants<T>& pair, const Pack<T>& weight, ContactPack<T>& t) {
  t.law.kn = weight * pair.kn;
  t.law.kt = weight * pair.kt;
  t.law.mu = pair.mu;
  t.law.kd = weight * pair.kd;
  t.law.damping = pair.damping;
  t.law.elastic = elastic;
  t.v = pair.velocity(t.x);
  if constexpr (elastic) {
    t.law.ks = weight * pair.ks;
    t.law.rounding = pair.rounding * (abs(t.x.x) + abs(t.x.y) + abs(t.x.z));
    t.e = select3<Pack<T>>(t.has_anchor, t.x - t.anchor, zero3<Pack<T>>());
  }
}

// Runs of neighbouring leaves that may touch, in the order of the cloud.
struct CandidateRuns {
  std::vector<std::pair<int, int>> runs;  // begin, end
  int points = 0;
};
// They are this thread's own, and made anew by the next call.
template <class T>
const CandidateRuns& candidate_runs(const PairFrame<T>& frame, const PointCloud& cloud, const T& reach) {
  thread_local CandidateRuns own;
  CandidateRuns& candidates = own;  // asked for once
  candidates.runs.clear();
  candidates.points = 0;
  for_candidate_leaves<T>(frame, cloud, reach, [&](int begin, int end) {
    candidates.points += end - begin;
    if (!candidates.runs.empty() && candidates.runs.back().second == begin) {
      candidates.runs.back().second = end;
    } else {
      candidates.runs.emplace_back(begin, end);
    }
  });
  return candidates;
}

// The points of a cloud in a precision; behind the last stand zeros.
template <class T>
struct CloudArrays {
  const double *x, *y, *z, *weights;
  explicit CloudArrays(const PointCloud& c)
      : x(c.points.x.data()), y(c.points.y.data()), z(c.points.z.data()), weights(c.weights.data()) {}
};
template <>
struct CloudArrays<float> {
  const float *x, *y, *z, *weights;
  explicit CloudArrays(const PointCloud& c)
      : x(c.rounded.x.data()), y(c.rounded.y.data()), z(c.rounded.z.data()), weights(c.rounded.weights.data()) {}
};

// Calls f(touching) for all points of these runs that are inside the shape, a pack at a time, and skipped(begin, end) for
// those between and around, in the order of the cloud. Some packs are placed before the first of them is felt: two short
// loops that keep their constants at hand, of which a processor works at several rounds at once.
template <bool with_hessian, bool elastic, class T, class F, class Skipped>
GELFLOW_INLINE void for_contact_points(const PairFrame<T>& frame, const PointCloud& cloud,
                                       const CandidateRuns& candidates, const ContactSettings<T>& settings, F&& f,
                                       Skipped&& skipped) {
  using P = Pack<T>;
  constexpr int width = pack_width<T>, batch = 16;
  struct PackGeometry {
    Vec3<P> x, n;
    P d, weight;  // felt: weight where it touches, else 0
  };
  PackGeometry geometry[batch];
  struct Curvatures {  // of which just what a shape has is written
    P curvature;
    Mat3<P> hessian;
  };
  Curvatures curvatures[with_hessian ? batch : 1];
  HessianForm form{};
  const PairConstants<T> pair(frame, settings);
  const bool weighs = frame.scaled && !cloud.areas.empty();
  const CloudArrays<T> listed(cloud);
  const auto transform = [&](int begin, int end) GELFLOW_LOOP_BODY {
    with_distance<with_hessian, P, T>(frame.kind, frame.size, frame.grid, [&](auto&& of) GELFLOW_LOOP_BODY {
      for (int i = begin, n = 0; i < end; i += width, ++n) {
        PackGeometry& p = geometry[n];
        Distance<P> at;
        const Vec3<P> x = pair.to_shape_frame({load<P>(listed.x + i), load<P>(listed.y + i), load<P>(listed.z + i)});
        p.x.x = x.x, p.x.y = x.y, p.x.z = x.z;  // one by one they stay in registers
        of(x, at);
        p.d = at.d;
        p.n.x = at.n.x, p.n.y = at.n.y, p.n.z = at.n.z;
        p.weight = select(at.d < P(0.0), load<P>(listed.weights + i), P(0.0));
        form = at.form;
        if constexpr (with_hessian) {
          if (at.form == HessianForm::isotropic) {
            curvatures[n].curvature = at.curvature;
          } else if (at.form != HessianForm::zero) {
            curvatures[n].hessian = at.hessian;
          }
        }
      }
    });
    for (int i = begin; weighs && i < std::min(end, cloud.size()); ++i) {
      PackGeometry& p = geometry[(i - begin) / width];
      const int k = (i - begin) % width;
      if (lane(p.weight, k) > T(0)) set_lane(p.weight, k, scaled_weight(frame, cloud, i));
    }
  };
  const auto visit_pack = [&](int i, int n) GELFLOW_LOOP_BODY {
    const PackGeometry& p = geometry[n];
    ContactPack<T> t;
    t.active = p.weight > P(0.0);
    if (!any(t.active)) return skipped(i, std::min(i + width, cloud.size()));
    t.has_anchor = first_lanes<P>(0);
    if constexpr (elastic) {
      T anchors[3][width] = {}, has_anchor[width] = {};
      for (int k = 0; k < width && i + k < cloud.size(); ++k) {
        if (!settings.anchored[i + k]) continue;
        for (int a = 0; a < 3; ++a) anchors[a][k] = settings.anchors[i + k][a];
        has_anchor[k] = T(1);
      }
      t.anchor = {load<P>(anchors[0]), load<P>(anchors[1]), load<P>(anchors[2])};
      t.has_anchor = load<P>(has_anchor) > P(0.0);
    }
    t.first = i;
    t.x = p.x;
    t.center = {p.x.x, p.x.y, p.x.z + pair.center_height};
    t.at.d = p.d;
    t.at.n = p.n;
    t.at.form = form;
    if constexpr (with_hessian) {
      if (form == HessianForm::isotropic) {
        t.at.curvature = curvatures[n].curvature;
      } else if (form != HessianForm::zero) {
        t.at.hessian = curvatures[n].hessian;
      }
    }
    eval_contact<elastic, T>(pair, p.weight, t);
    f(static_cast<const ContactPack<T>&>(t));
  };
  int visited = 0;
  for (const auto& [first, last] : candidates.runs) {
    skipped(visited, first);
    visited = last;
    for (int begin = first; begin < last; begin += batch * width) {
      const int end = std::min(begin + batch * width, last);
      transform(begin, end);
      for (int i = begin, n = 0; i < end; i += width, ++n) visit_pack(i, n);
    }
  }
  skipped(visited, cloud.size());
}
template <bool with_hessian, class T, class F, class Skipped>
GELFLOW_INLINE void for_contact_points(const PairFrame<T>& frame, const PointCloud& cloud,
                                       const CandidateRuns& candidates, const ContactSettings<T>& settings, F&& f,
                                       Skipped&& skipped) {
  if (settings.law == FrictionLaw::elastic) {
    for_contact_points<with_hessian, true, T>(frame, cloud, candidates, settings, f, skipped);
  } else {
    for_contact_points<with_hessian, false, T>(frame, cloud, candidates, settings, f, skipped);
  }
}
template <bool with_hessian, class T, class F>
void for_contact_points(const PairFrame<T>& frame, const PointCloud& cloud, const ContactSettings<T>& settings, F&& f) {
  for_contact_points<with_hessian, T>(frame, cloud, candidate_runs<T>(frame, cloud, settings.rolling_radius), settings,
                                      f, [](int, int) {});
}

// The same for points that were found near.
template <bool with_hessian, class T, class F>
GELFLOW_INLINE void for_contact_points(const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                                       const ContactSettings<T>& settings, F&& f) {
  using P = Pack<T>;
  const PairConstants<T> pair(frame, settings);
  for (int i = 0; i < candidates.count; i += pack_width<T>) {
    const Vec3<P> local{load<P>(&candidates.x[i]), load<P>(&candidates.y[i]), load<P>(&candidates.z[i])};
    const P weight = load<P>(&candidates.weight[i]);
    ContactPack<T> t;
    t.x = pair.to_shape_frame(local);
    t.center = {t.x.x, t.x.y, t.x.z + pair.center_height};
    distance<with_hessian>(frame.kind, frame.size, frame.grid, t.x, t.at);
    t.active = t.at.d < P(0.0) && weight > P(0.0);
    if (!any(t.active)) continue;
    t.has_anchor = first_lanes<P>(0);
    if (pair.elastic) {
      t.anchor = {load<P>(&candidates.anchor_x[i]), load<P>(&candidates.anchor_y[i]), load<P>(&candidates.anchor_z[i])};
      t.has_anchor = load<P>(&candidates.has_anchor[i]) > P(0.0);
    }
    t.index = &candidates.index[i];
    if (pair.elastic) {
      eval_contact<true, T>(pair, select(t.active, weight, P(0.0)), t);
    } else {
      eval_contact<false, T>(pair, select(t.active, weight, P(0.0)), t);
    }
    f(static_cast<const ContactPack<T>&>(t));
  }
}

// The anchors of one cloud after an accepted step, of those points that were found near; `next` and `next_set` may be the
// arrays that were read for that.
template <class T>
void advance_anchors(const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                     const ContactSettings<T>& settings, int cloud_size, V3<T>* next, std::uint8_t* next_set) {
  std::fill(next_set, next_set + cloud_size, 0);
  for_contact_points<false, T>(frame, candidates, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    PointForce<Pack<T>> force;
    point_force<false>(t.law, t.at, t.v, t.e, t.has_anchor, force);
    const Vec3<Pack<T>> anchor = next_anchor(t.law, Pack<T>(settings.h), force, t.x, t.anchor, t.has_anchor);
    t.for_each_active([&](int k, int i) {
      next[i] = lane3<T>(anchor, k);
      next_set[i] = 1;
    });
  });
}

// The reverse of `advance_anchors`: gradients of the anchors after the step go to the relative pose and twist and to the
// anchors before.
template <class T, class Points>
void anchors_vjp(const PairFrame<T>& frame, const Points& points, const ContactSettings<T>& settings,
                 const V3<T>* by_next, V6<T>& by_pose, V6<T>& by_twist, V3<T>* by_anchor) {
  using P = Pack<T>;
  Vec3<P> turn = zero3<P>(), shift = turn, spin = turn, slide = turn;
  for_contact_points<true, T>(frame, points, settings, [&](const ContactPack<T>& t) {
    Vec3<P> lambda = zero3<P>();
    t.for_each_active([&](int k, int i) { set_lane3<T>(lambda, k, by_next[i]); });
    const PointGradient<P> g = next_anchor_vjp(t.law, P(settings.h), t.at, t.v, t.e, t.has_anchor, lambda);
    const Vec3<P> by_point = g.x - cross(broadcast<P>(frame.angular), g.v);
    turn += cross(t.center, by_point);
    shift += by_point;
    spin += cross(t.x, g.v);
    slide += g.v;
    t.for_each_active([&](int k, int i) {
      if (is_set(t.has_anchor, k)) by_anchor[i] += lane3<T>(g.anchor, k);
    });
  });
  by_pose += stack<T>(sum3<T>(turn), sum3<T>(shift));
  by_twist += stack<T>(sum3<T>(spin), sum3<T>(slide));
}

}  // namespace gelflow
