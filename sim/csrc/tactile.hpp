// What the markers of the pads feel (eq. 8c), the turn of their anchors, and the reverse pass (eqs. 9-10) as
// vector-Jacobian products: nothing of size markers × dofs is stored.
//
// With f the force on the pad at a marker, in the pad's frame, and x, y, z the marker's axes:
//     (shear_x, shear_y, normal) = (f·x, f·y, −f·z)
#pragma once

#include "pair.hpp"

namespace gelflow {

// Calls f(slot, i, x, law, distance, v, e, anchor, remembers) for every marker of the pad inside shape number s.
template <class T, class F, class Skip>
void for_touched_markers(const Pad& pad, int s, const T* params, const T& h, const PairFrame<T>& frame,
                         const V3<T>* anchors, const std::uint8_t* anchored, F&& f, Skip&& outside) {
  const PointLaw<T> numbers = law_numbers<T>(params + pad.param, pad.law, DampingLaw::depth, h);
  const int slot = pad.anchor + s * pad.cloud.size();
  Distance<T> at;
  for_near_points<T>(
      frame, pad.cloud, 0.0,
      [&](int i) {
        const V3<T> x = frame.point(pad.cloud.points[i]);
        distance<T>(frame.kind, frame.size, x, at);
        if (!(at.d < T(0))) {
          outside(i, i + 1);
          return;
        }
        const PointLaw<T> law = weighted<T>(numbers, pad.cloud.weights[i]);
        const V3<T> v = frame.velocity(x);
        const bool remembers = numbers.elastic && anchored[slot + i];
        const V3<T> anchor = remembers ? anchors[slot + i] : V3<T>(V3<T>::Zero());
        f(slot + i, i, x, law, at, v, anchor_offset<T>(law, x, v, anchor, remembers), anchor, remembers);
      },
      outside);
}

// Readings of all markers, shape (markers, 3); needs the kinematics of (q, v) in w.
template <class T>
void read_markers(const Model& m, const T* params, const T& h, const V3<T>* anchors, const std::uint8_t* anchored,
                  const Workspace<T>& w, T* out) {
  std::fill(out, out + 3 * static_cast<std::size_t>(m.markers), T(0));
  PointForce<T> force;
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.body, m.shapes[pad.shapes[s]], w);
      for_touched_markers<T>(
          pad, static_cast<int>(s), params, h, frame, anchors, anchored,
          [&](int, int i, const V3<T>&, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v, const V3<T>& e,
              const V3<T>&, bool remembers) {
            point_force<0, T>(law, at, v, e, remembers, force);
            const V3<T> local =
                pad.frames[i].template cast<T>().transpose() * (frame.rotation.transpose() * force.force);
            T* reading = out + 3 * static_cast<std::size_t>(pad.first_marker + pad.cloud.original[i]);
            reading[0] += local[0];
            reading[1] += local[1];
            reading[2] -= local[2];
          },
          [](int, int) {});
    }
  }
}

template <class T>
void advance_marker_anchors(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                            const std::uint8_t* anchored, const Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  PointForce<T> force;
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0) continue;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.body, m.shapes[pad.shapes[s]], w);
      const int base = pad.anchor + static_cast<int>(s) * pad.cloud.size();
      for_touched_markers<T>(
          pad, static_cast<int>(s), params, h, frame, anchors, anchored,
          [&](int slot, int, const V3<T>& x, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v,
              const V3<T>& e, const V3<T>& anchor, bool remembers) {
            point_force<0, T>(law, at, v, e, remembers, force);
            next[slot] = next_anchor<T>(law, force, at.n, x, e, anchor, remembers);
            next_set[slot] = 1;
          },
          [&](int begin, int end) { std::fill(next_set + base + begin, next_set + base + end, 0); });
    }
  }
}

// Adds, to by_q, by_v and by_anchor, the gradient of readings with gradient `by_reading`, shape (markers, 3), at the
// state whose kinematics are in w. by_anchor may be null where there are no anchors.
template <class T>
void read_markers_transposed(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                             const std::uint8_t* anchored, const Workspace<T>& w, const T* by_reading, VX<T>& by_q,
                             VX<T>& by_v, V3<T>* by_anchor) {
  PointForce<T> force;
  PairColumns<T> c;
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.body, m.shapes[pad.shapes[s]], w);
      V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
      for_touched_markers<T>(
          pad, static_cast<int>(s), params, h, frame, anchors, anchored,
          [&](int slot, int i, const V3<T>& x, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v,
              const V3<T>& e, const V3<T>&, bool remembers) {
            const T* g = by_reading + 3 * static_cast<std::size_t>(pad.first_marker + pad.cloud.original[i]);
            if (g[0] == T(0) && g[1] == T(0) && g[2] == T(0)) return;
            point_force<2, T>(law, at, v, e, remembers, force);
            const V3<T> by_force = frame.rotation * (pad.frames[i].template cast<T>() * V3<T>(g[0], g[1], -g[2]));
            const V3<T> by_velocity = force.by_v.transpose() * by_force;
            const V3<T> by_point = force.by_x.transpose() * by_force - cross<T>(frame.angular, by_velocity);
            by_pose +=
                stack<T>(cross<T>(x, by_point) + cross<T>(by_force, force.force), by_point);  // the axes turn too
            by_twist += stack<T>(cross<T>(x, by_velocity), by_velocity);
            if (remembers) by_anchor[slot] += force.by_anchor.transpose() * by_force;
          },
          [](int, int) {});
      pair_columns<true, T>(pad.pairs[s], pad.body, frame, w, c);
      pull_back<T>(pad.pairs[s], c, by_pose, by_twist, by_q, by_v);
    }
  }
}

// The same for the anchors' turn: gradients of the anchors after the step to the step's end and the anchors before.
template <class T>
void marker_anchors_transposed(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                               const std::uint8_t* anchored, const Workspace<T>& w, const V3<T>* by_next, VX<T>& by_q,
                               VX<T>& by_v, V3<T>* by_anchor) {
  PointForce<T> force;
  PairColumns<T> c;
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0) continue;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.body, m.shapes[pad.shapes[s]], w);
      V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
      for_touched_markers<T>(
          pad, static_cast<int>(s), params, h, frame, anchors, anchored,
          [&](int slot, int, const V3<T>& x, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v,
              const V3<T>& e, const V3<T>&, bool remembers) {
            point_force<2, T>(law, at, v, e, remembers, force);
            const AnchorGradient<T> g = next_anchor_transposed<T>(law, force, remembers, by_next[slot]);
            const V3<T> by_point = g.x - cross<T>(frame.angular, g.v);
            by_pose += stack<T>(cross<T>(x, by_point), by_point);
            by_twist += stack<T>(cross<T>(x, g.v), g.v);
            if (remembers) by_anchor[slot] += g.anchor;
          },
          [](int, int) {});
      pair_columns<true, T>(pad.pairs[s], pad.body, frame, w, c);
      pull_back<T>(pad.pairs[s], c, by_pose, by_twist, by_q, by_v);
    }
  }
}

}  // namespace gelflow
