// What the markers of the pads feel (eq. 8c), the turn of their anchors, and the reverse pass (eqs. 9-10) as
// vector-Jacobian products: nothing of size markers × dofs is stored.
//
// With f the force on the pad at a marker, in the pad's frame, and x, y, z the marker's axes:
//     (shear_x, shear_y, normal) = (f·x, f·y, −f·z)
#pragma once

#include "pair_columns.hpp"
#include "touching.hpp"

namespace gelflow {

// The markers of a pad against the shape number s of those it feels.
template <class T>
TouchRule<T> touch_rule(const Pad& pad, std::size_t s, const T* params, const V3<T>* anchors,
                        const std::uint8_t* anchored) {
  const std::size_t slot = pad.anchor < 0 ? 0 : pad.anchor + s * pad.cloud.size();
  return {params + pad.param, pad.law, DampingLaw::depth, T(0), anchors + slot, anchored + slot};
}

// Readings of all markers, shape (markers, 3); needs the kinematics of (q, v) in w.
template <class T>
void read_markers(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                  const Workspace<T>& w, T* out) {
  std::fill(out, out + 3 * static_cast<std::size_t>(m.markers), T(0));
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      for_touching_points<T>(
          frame, pad.cloud, touch_rule<T>(pad, s, params, anchors, anchored), [&](const Touching<T>& t) {
            PointForce<Pack<T>> force;
            point_force<0>(t.law, t.at, t.v, t.e, t.remembers, force);
            const Vec3<Pack<T>> in_body = transposed_times(spread<Pack<T>>(frame.rotation), force.force);
            t.for_each_inside([&](int k, int i) {
              const V3<T> f = lane3<T>(in_body, k);
              const M3<double>& axes = pad.frames[i];
              T* reading = out + 3 * static_cast<std::size_t>(pad.first_marker + pad.cloud.original[i]);
              for (int a = 0; a < 3; ++a) {
                const T component = T(axes(0, a)) * f[0] + T(axes(1, a)) * f[1] + T(axes(2, a)) * f[2];
                reading[a] += a < 2 ? component : T(-component);
              }
            });
          });
    }
  }
}

template <class T>
void advance_marker_anchors(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                            Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0 || pad.pushes) continue;  // the anchors of its contacts have moved on
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      const TouchRule<T> rule = touch_rule<T>(pad, s, params, anchors, anchored);
      find_near_points<T>(frame, pad.cloud, rule, false, w.near_markers);
      advance_anchors<T>(frame, w.near_markers, rule, pad.cloud.size(), next + slot, next_set + slot);
    }
  }
}

// Adds, to by_q, by_v and by_anchor, the gradient of readings with gradient `by_reading`, shape (markers, 3), at the
// state whose kinematics are in w. by_anchor may be null where there are no anchors.
template <class T>
void read_markers_transposed(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                             Workspace<T>& w, const T* by_reading, VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  using L = Pack<T>;
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      Vec3<L> turn = zero3<L>(), shift = turn, spin = turn, slide = turn;
      V3<T>* const by_own = pad.anchor < 0 ? nullptr : by_anchor + pad.anchor + s * pad.cloud.size();
      for_touching_points<T>(
          frame, pad.cloud, touch_rule<T>(pad, s, params, anchors, anchored), [&](const Touching<T>& t) {
            Vec3<L> by_force = zero3<L>();
            t.for_each_inside([&](int k, int i) {
              const T* g = by_reading + 3 * static_cast<std::size_t>(pad.first_marker + pad.cloud.original[i]);
              const V3<T> in_body = pad.frames[i].template cast<T>() * V3<T>(g[0], g[1], -g[2]);
              set_lane3<T>(by_force, k, V3<T>(frame.rotation * in_body));
            });
            PointForce<L> force;
            point_force<2>(t.law, t.at, t.v, t.e, t.remembers, force);
            const Vec3<L> by_velocity = transposed_times(force.by_v, by_force);
            const Vec3<L> by_point =
                transposed_times(force.by_x, by_force) - cross(spread<L>(frame.angular), by_velocity);
            turn += cross(t.x, by_point) + cross(by_force, force.force);  // the axes turn too
            shift += by_point;
            spin += cross(t.x, by_velocity);
            slide += by_velocity;
            if (by_own == nullptr) return;
            const Vec3<L> by = transposed_times(force.by_anchor, by_force);
            t.for_each_inside([&](int k, int i) { by_own[i] += lane3<T>(by, k); });
          });
      const V6<T> by_pose = stack<T>(sum3<T>(turn), sum3<T>(shift)), by_twist = stack<T>(sum3<T>(spin), sum3<T>(slide));
      pair_columns<true, T>(pad.pairs[s], pad.mount.body, frame, w);
      pull_back<T>(w.columns, by_pose, by_twist, by_q, by_v);
    }
  }
}

// The same for the anchors' turn: gradients of the anchors after the step to the step's end and the anchors before.
template <class T>
void marker_anchors_transposed(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                               Workspace<T>& w, const V3<T>* by_next, VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0 || pad.pushes) continue;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
      anchors_transposed<T>(frame, pad.cloud, touch_rule<T>(pad, s, params, anchors, anchored), by_next + slot, by_pose,
                            by_twist, by_anchor + slot);
      pair_columns<true, T>(pad.pairs[s], pad.mount.body, frame, w);
      pull_back<T>(w.columns, by_pose, by_twist, by_q, by_v);
    }
  }
}

}  // namespace gelflow
