// Update of the anchors of one point cloud against one shape (contact_anchors.hpp: of all contacts of the model), and
// its vector-Jacobian product.
#pragma once

#include <cstring>

#include "contact/contact_point_loops.hpp"

namespace gelflow {

// Anchors of the points of a pack after a step.
template <class T>
GELFLOW_INLINE Vec3<Pack<T>> next_anchors(const ContactPack<T>& t, const T& step_length) {
  PointForce<Pack<T>> force;
  point_force<false>(t.law, t.at, t.v, t.e, t.has_anchor, force);
  return next_anchor(t.law, Pack<T>(step_length), force, t.x, t.anchor, t.has_anchor);
}

// Anchors after an accepted step at the candidate points; `next` and `next_set` may be the arrays that are read.
template <class T>
void advance_anchors(const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                     const ContactSettings<T>& settings, int cloud_size, V3<T>* next, std::uint8_t* next_set) {
  std::fill(next_set, next_set + cloud_size, 0);
  for_contact_points<false, T>(frame, candidates, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    const Vec3<Pack<T>> anchor = next_anchors<T>(t, settings.step_length);
    t.for_each_active([&](int k, int i) {
      next[i] = lane3<T>(anchor, k);
      next_set[i] = 1;
    });
  });
}

// The same at all points of a cloud, without candidates of the step.
template <class T>
void advance_anchors(const PairFrame<T>& frame, const PointCloud& cloud, const ContactSettings<T>& settings,
                     V3<T>* next, std::uint8_t* next_set) {
  const auto advance = [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    const Vec3<Pack<T>> anchor = next_anchors<T>(t, settings.step_length);
    const unsigned active = bits(t.active);
    for (int k = 0; k < std::min(pack_width<T>, cloud.size() - t.first); ++k) next_set[t.first + k] = active >> k & 1U;
    if constexpr (has_fours<T>) {
      if (active == (1U << pack_width<T>)-1) return store_vectors<T>(anchor, next[t.first].data());
    }
    t.for_each_active([&](int k, int i) { next[i] = lane3<T>(anchor, k); });
  };
  for_contact_points<false, true, T>(frame, cloud, candidate_runs<T>(frame, cloud, settings.rolling_radius), settings,
                                     advance, [&](int begin, int end) GELFLOW_LOOP_BODY {
                                       if (end - begin > pack_width<T>) {
                                         std::memset(next_set + begin, 0, end - begin);
                                       } else {  // usually one pack: a loop costs less than a call
                                         for (int i = begin; i < end; ++i) next_set[i] = 0;
                                       }
                                     });
}

// Vector-Jacobian product of `advance_anchors`: adds the gradients with respect to the relative pose, the relative twist
// and the anchors before the step.
template <class T, class Points>
void anchors_vjp(const PairFrame<T>& frame, const Points& points, const ContactSettings<T>& settings,
                 const V3<T>* grad_next, V6<T>& grad_pose, V6<T>& grad_twist, V3<T>* grad_anchor) {
  using P = Pack<T>;
  Vec3<P> rotation = zero3<P>(), translation = rotation, angular = rotation, linear = rotation;
  for_contact_points<true, T>(frame, points, settings, [&](const ContactPack<T>& t) {
    Vec3<P> lambda = zero3<P>();
    t.for_each_active([&](int k, int i) { set_lane3<T>(lambda, k, grad_next[i]); });
    const PointGradient<P> g = next_anchor_vjp(t.law, P(settings.step_length), t.at, t.v, t.e, t.has_anchor, lambda);
    const Vec3<P> grad_point = g.x - cross(broadcast<P>(frame.angular), g.v);
    rotation += cross(t.center, grad_point);
    translation += grad_point;
    angular += cross(t.x, g.v);
    linear += g.v;
    t.for_each_active([&](int k, int i) {
      if (is_set(t.has_anchor, k)) grad_anchor[i] += lane3<T>(g.anchor, k);
    });
  });
  grad_pose += stack<T>(sum3<T>(rotation), sum3<T>(translation));
  grad_twist += stack<T>(sum3<T>(angular), sum3<T>(linear));
}

}  // namespace gelflow
