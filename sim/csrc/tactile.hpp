// What the markers of the pads feel (eq. 8c), the turn of their anchors, and the reverse pass (eqs. 9-10) as
// vector-Jacobian products: nothing of size markers × dofs is stored.
//
// With f the force on the pad at a marker, in the pad's frame, and x, y, z the marker's axes:
//     (shear_x, shear_y, normal) = (f·x, f·y, −f·z)
#pragma once

#include "pair_columns.hpp"
#include "touching.hpp"

namespace gelflow {

// The markers of a pad against the shape number s of those it feels; h: of the step that anchors make.
template <class T>
TouchRule<T> touch_rule(const Pad& pad, std::size_t s, const T* params, const V3<T>* anchors,
                        const std::uint8_t* anchored, const T& h = T(0)) {
  const std::size_t slot = pad.anchor < 0 ? 0 : pad.anchor + s * pad.cloud.size();
  return {params + pad.param, pad.law, DampingLaw::depth, T(0), anchors + slot, anchored + slot, 1, h};
}

// Which readings in an array may be other than zero: all, or those of these markers. Mostly few markers touch, and to
// clear them all costs more than to read those.
struct Written {
  bool all = true;
  std::vector<int> markers;
};

// Readings of all markers, shape (markers, 3); needs the kinematics of (q, v) in w. `written`: what is not zero in `out`
// now, and then; null where nobody keeps account.
template <class T>
void read_markers(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                  const Workspace<T>& w, T* out, Written* written) {
  using L = Pack<T>;
  constexpr unsigned whole_pack = (1U << pack_width<T>)-1;
  if (written == nullptr || written->all) {
    std::fill(out, out + 3 * static_cast<std::size_t>(m.markers), T(0));
  } else {
    for (const int marker : written->markers) std::fill_n(out + 3 * static_cast<std::size_t>(marker), 3, T(0));
  }
  const std::size_t few = static_cast<std::size_t>(m.markers) / 8;
  if (written != nullptr) {
    written->all = false;
    written->markers.clear();
    written->markers.reserve(few + pack_width<T>);
  }
  const auto write_down = [&](const Pad& pad, const Touching<T>& t) GELFLOW_LOOP_BODY {
    if (written == nullptr || written->all) return;
    t.for_each_inside([&](int, int i) { written->markers.push_back(pad.first_marker + pad.cloud.original[i]); });
    written->all = written->markers.size() > few;
  };
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const TouchRule<T> rule = touch_rule<T>(pad, s, params, anchors, anchored);
      T* const readings = out + 3 * static_cast<std::size_t>(pad.first_marker);
      const Mat3<L> axes = spread<L>(M3<T>(frame.rotation * pad.frames[0].template cast<T>()));
      for_touching_points<false, T>(frame, pad.cloud, rule, [&](const Touching<T>& t) GELFLOW_LOOP_BODY {
        PointForce<L> force;
        point_force<false>(t.law, t.at, t.v, t.e, t.remembers, force);
        write_down(pad, t);
        if (pad.flat) {
          const Vec3<L> felt = transposed_times(axes, force.force);
          T numbers[3][pack_width<T>];
          for (int a = 0; a < 3; ++a) store(a < 2 ? felt[a] : -felt[a], numbers[a]);
          const int* const original = pad.cloud.original.data() + t.first;
          const auto write = [&](int k) GELFLOW_LOOP_BODY {
            T* const reading = readings + 3 * static_cast<std::size_t>(original[k]);
            for (int a = 0; a < 3; ++a) reading[a] = s == 0 ? numbers[a][k] : T(reading[a] + numbers[a][k]);
          };
          if (bits(t.inside) == whole_pack) {
            for (int k = 0; k < pack_width<T>; ++k) write(k);
          } else {
            t.for_each_inside([&](int k, int) GELFLOW_LOOP_BODY { write(k); });
          }
          return;
        }
        const Vec3<L> in_body = transposed_times(spread<L>(frame.rotation), force.force);
        t.for_each_inside([&](int k, int i) {
          const V3<T> felt = pad.frames[i].transpose().template cast<T>() * lane3<T>(in_body, k);
          T* const reading = readings + 3 * static_cast<std::size_t>(pad.cloud.original[i]);
          for (int a = 0; a < 3; ++a) reading[a] += a < 2 ? felt[a] : T(-felt[a]);
        });
      });
    }
  }
}

template <class T>
void advance_marker_anchors(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                            const std::uint8_t* anchored, Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0 || pad.pushes) continue;  // the anchors of its contacts have moved on
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      const TouchRule<T> rule = touch_rule<T>(pad, s, params, anchors, anchored, h);
      find_near_points<T>(frame, pad.cloud, rule, Found::elsewhere, w.near_markers);
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
      const TouchRule<T> rule = touch_rule<T>(pad, s, params, anchors, anchored);
      const T* const by_readings = by_reading + 3 * static_cast<std::size_t>(pad.first_marker);
      const Mat3<L> axes = spread<L>(M3<T>(frame.rotation * pad.frames[0].template cast<T>()));
      for_touching_points<true, T>(frame, pad.cloud, rule, [&](const Touching<T>& t) GELFLOW_LOOP_BODY {
        T numbers[3][pack_width<T>] = {};
        t.for_each_inside([&](int k, int i) {
          const T* const g = by_readings + 3 * static_cast<std::size_t>(pad.cloud.original[i]);
          V3<T> by(g[0], g[1], -g[2]);
          if (!pad.flat) by = (frame.rotation * (pad.frames[i].template cast<T>() * by)).eval();
          for (int a = 0; a < 3; ++a) numbers[a][k] = by[a];
        });
        Vec3<L> by_force{load<L>(numbers[0]), load<L>(numbers[1]), load<L>(numbers[2])};
        if (pad.flat) by_force = axes * by_force;
        const PointGradient<L> g =
            point_force_transposed(t.law, t.at, t.v, t.e, t.remembers, by_force, by_force, zero3<L>(), zero3<L>());
        const Vec3<L> by_point = g.x - cross(spread<L>(frame.angular), g.v);
        turn += cross(t.x, by_point) + cross(by_force, g.force);  // the axes turn too
        shift += by_point;
        spin += cross(t.x, g.v);
        slide += g.v;
        if (by_own == nullptr) return;
        t.for_each_inside([&](int k, int i) { by_own[i] += lane3<T>(g.anchor, k); });
      });
      const V6<T> by_pose = stack<T>(sum3<T>(turn), sum3<T>(shift)), by_twist = stack<T>(sum3<T>(spin), sum3<T>(slide));
      pair_columns<T>(pad.pairs[s], pad.mount.body, frame, w);
      pull_back<T>(w.columns, by_pose, by_twist, by_q, by_v);
    }
  }
}

// The same for the anchors' turn: gradients of the anchors after the step to the step's end and the anchors before.
template <class T>
void marker_anchors_transposed(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                               const std::uint8_t* anchored, Workspace<T>& w, const V3<T>* by_next, VX<T>& by_q,
                               VX<T>& by_v, V3<T>* by_anchor) {
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0 || pad.pushes) continue;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
      anchors_transposed<T>(frame, pad.cloud, touch_rule<T>(pad, s, params, anchors, anchored, h), by_next + slot,
                            by_pose, by_twist, by_anchor + slot);
      pair_columns<T>(pad.pairs[s], pad.mount.body, frame, w);
      pull_back<T>(w.columns, by_pose, by_twist, by_q, by_v);
    }
  }
}

}  // namespace gelflow
