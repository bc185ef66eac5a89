// Tactile forces at the pad markers (eq. 8c), the update of their anchors, and the vector-Jacobian products of both
// (eqs. 9-10); no matrix of size markers × dofs is stored.
//
// With f the force on the pad at a marker, in the pad's frame, and x, y, z the marker's axes:
//     (shear_x, shear_y, normal) = (f·x, f·y, −f·z)
//
// Equation numbers are those of the appendix of Xu et al., "Efficient Tactile Simulation with Differentiability for
// Robotic Manipulation", CoRL 2022.
#pragma once

#include "contact/cloud_anchors.hpp"
#include "contact/contact_jacobian.hpp"
#include "contact/readings_view.hpp"

namespace gelflow {

// Axes of the markers of a flat pad in the shape's frame.
template <class T>
GELFLOW_INLINE Mat3<Pack<T>> marker_axes(const Pad& pad, const PairFrame<T>& frame) {
  return broadcast<Pack<T>>(M3<T>(frame.rotation * pad.frames[0].template cast<T>()));
}

// Reads the markers of a pad against its shape number s. The first shape overwrites the readings of active markers and,
// where `clears_inactive`, sets those of the others to zero; further shapes add to them.
template <class T>
GELFLOW_INLINE void read_pad(const Pad& pad, std::size_t s, const PairFrame<T>& frame,
                             const ContactSettings<T>& settings, const CandidateRuns& candidates, bool clears_inactive,
                             const ReadingsView<T, T>& readings, NonzeroTracker<T>& tracker) {
  using P = Pack<T>;
  constexpr unsigned whole_pack = (1U << pack_width<T>)-1;
  const Mat3<P> axes = marker_axes<T>(pad, frame);
  const bool first = s == 0;
  const auto read = [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    PointForce<P> force;
    point_force<false>(t.law, t.at, t.v, t.e, t.has_anchor, force);
    const unsigned active = bits(t.active);
    tracker.add(pad, t, active);
    if (!pad.flat) [[unlikely]] {
      const Vec3<P> in_shape = force.force;  // a copy: taking the address of `force.force` would keep it in memory
      return add_to_curved_pad<T>(pad, frame, t.first, active, in_shape, readings);
    }
    Vec3<P> reading = transposed_times(axes, force.force);
    reading.z = -reading.z;
    if (first) {
      if (active == whole_pack || !clears_inactive) return readings.write(t.first, active, reading);
      const unsigned existing = whole_pack >> std::max(0, t.first + pack_width<T> - pad.cloud.size());
      readings.write(t.first, existing, select3<P>(t.active, reading, zero3<P>()));
    } else {
      t.for_each_active([&](int k, int i) {
        T* const sum = readings[i];
        for (int a = 0; a < 3; ++a) sum[a] += lane(reading[a], k);
      });
    }
  };
  for_contact_points<false, T>(frame, pad.cloud, candidates, settings, read, [&](int begin, int end) GELFLOW_LOOP_BODY {
    if (clears_inactive) readings.clear(begin, end);
  });
}

// Readings of all markers, shape (markers, 3); requires the kinematics of (q, v) in w. `nonzero`: which entries of `out`
// differ from zero, before and after; null where that is not tracked.
template <class T>
void read_markers(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                  const Workspace<T>& w, T* out, NonzeroMarkers* nonzero) {
  NonzeroTracker<T> tracker(m, out, nonzero);
  for (const Pad& pad : m.pads) {
    const ReadingsView<T, T> readings(pad, out);
    bool is_clear = !tracker.must_clear();
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const ContactSettings<T> settings = contact_settings<T>(pad, s, params, anchors, anchored);
      const CandidateRuns& candidates = candidate_runs<T>(frame, pad.cloud, settings.rolling_radius);
      if (!is_clear && (!pad.flat || 2 * candidates.points < pad.cloud.size())) {  // the usual case: few candidates
        readings.clear_all(pad.cloud.size());
        is_clear = true;
      }
      read_pad<T>(pad, s, frame, settings, candidates, !is_clear, readings, tracker);
      is_clear = true;
    }
    if (!is_clear) readings.clear_all(pad.cloud.size());  // a pad without shapes
  }
  tracker.finish();
}

// Anchors of the markers after an accepted step. Pads that collide share the anchors of their contacts. `next` and
// `next_set`: the arrays that are read, or copies of them.
template <class T>
void advance_marker_anchors(const Model& m, const T* params, const T& step_length, const V3<T>* anchors,
                            const std::uint8_t* anchored, Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  for (std::size_t p = 0; p < m.pads.size(); ++p) {
    const Pad& pad = m.pads[p];
    if (pad.anchor < 0 || pad.collides) continue;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      const ContactSettings<T> settings = contact_settings<T>(pad, s, params, anchors, anchored, step_length);
      PointRanges& ranges = w.anchored_markers[p][s];
      if (!w.knows_anchored_markers) ranges = {{0, pad.cloud.size()}};
      advance_anchors<T>(frame, pad.cloud, settings, next + slot, next_set + slot, ranges);
    }
  }
  w.knows_anchored_markers = true;
}

// Adds the gradients with respect to the relative pose and twist of a pad and its shape number s, and to the anchors
// before (null where there are none), of readings with gradient `grad_reading`.
template <class T>
GELFLOW_INLINE void read_pad_vjp(const Pad& pad, const PairFrame<T>& frame, const ContactSettings<T>& settings,
                                 const T* grad_reading, V3<T>* grad_anchor, V6<T>& grad_pose, V6<T>& grad_twist) {
  using P = Pack<T>;
  Vec3<P> rotation = zero3<P>(), translation = rotation, angular = rotation, linear = rotation;
  const ReadingsView<T, const T> grad_readings(pad, grad_reading);
  const Mat3<P> axes = marker_axes<T>(pad, frame);
  for_contact_points<true, T>(frame, pad.cloud, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    const unsigned active = bits(t.active);
    Vec3<P> grad_force = grad_readings.read(t.first, active);
    grad_force.z = -grad_force.z;
    if (pad.flat) [[likely]] {
      grad_force = axes * grad_force;
    } else {
      const Vec3<P> grad_marker_force =
          grad_force;  // a copy: taking the address of `grad_force` would keep it in memory
      const Vec3<P> in_shape = from_curved_pad<T>(pad, frame, t.first, active, grad_marker_force);
      for (int a = 0; a < 3; ++a) grad_force[a] = in_shape[a];
    }
    const PointGradient<P> g =
        point_force_vjp(t.law, t.at, t.v, t.e, t.has_anchor, grad_force, grad_force, zero3<P>(), zero3<P>());
    const Vec3<P> grad_point = g.x - cross(broadcast<P>(frame.angular), g.v);
    rotation += cross(t.x, grad_point) + cross(grad_force, g.force);  // the marker axes rotate too
    translation += grad_point;
    angular += cross(t.x, g.v);
    linear += g.v;
    if (grad_anchor == nullptr) return;
    t.for_each_active([&](int k, int i) { grad_anchor[i] += lane3<T>(g.anchor, k); });
  });
  grad_pose = stack<T>(sum3<T>(rotation), sum3<T>(translation));
  grad_twist = stack<T>(sum3<T>(angular), sum3<T>(linear));
}

// Adds to grad_q, grad_v and grad_anchor the gradient of readings with gradient `grad_reading`, shape (markers, 3), at
// the state whose kinematics are in w. grad_anchor may be null where there are no anchors.
template <class T>
void read_markers_vjp(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                      Workspace<T>& w, const T* grad_reading, VX<T>& grad_q, VX<T>& grad_v, V3<T>* grad_anchor) {
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      V3<T>* const grad_pad = pad.anchor < 0 ? nullptr : grad_anchor + pad.anchor + s * pad.cloud.size();
      V6<T> grad_pose, grad_twist;
      read_pad_vjp<T>(pad, frame, contact_settings<T>(pad, s, params, anchors, anchored), grad_reading, grad_pad,
                      grad_pose, grad_twist);
      contact_jacobian<T>(pad.pairs[s], pad.mount.body, frame, w);
      contact_jacobian_vjp<T>(w.jacobian, grad_pose, grad_twist, grad_q, grad_v);
    }
  }
}

// Gradients with respect to the anchors after the step (`grad_next`), carried to the state at the step's end and to the
// anchors before it.
template <class T>
void marker_anchors_vjp(const Model& m, const T* params, const T& step_length, const V3<T>* anchors,
                        const std::uint8_t* anchored, Workspace<T>& w, const V3<T>* grad_next, VX<T>& grad_q,
                        VX<T>& grad_v, V3<T>* grad_anchor) {
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0 || pad.collides) continue;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      V6<T> grad_pose = V6<T>::Zero(), grad_twist = V6<T>::Zero();
      anchors_vjp<T>(frame, pad.cloud, contact_settings<T>(pad, s, params, anchors, anchored, step_length),
                     grad_next + slot, grad_pose, grad_twist, grad_anchor + slot);
      contact_jacobian<T>(pad.pairs[s], pad.mount.body, frame, w);
      contact_jacobian_vjp<T>(w.jacobian, grad_pose, grad_twist, grad_q, grad_v);
    }
  }
}

}  // namespace gelflow
