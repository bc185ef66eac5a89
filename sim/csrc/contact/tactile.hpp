// What the markers of the pads feel (eq. 8c), the turn of their anchors, and the reverse pass (eqs. 9-10) as
// vector-Jacobian products: nothing of size markers × dofs is stored.
//
// With f the force on the pad at a marker, in the pad's frame, and x, y, z the marker's axes:
//     (shear_x, shear_y, normal) = (f·x, f·y, −f·z)
#pragma once

#include "contact/contact_jacobian.hpp"
#include "contact/contact_points.hpp"

namespace gelflow {

// The markers of a pad against the shape number s of those it feels; h: of the step that anchors make.
template <class T>
ContactSettings<T> contact_settings(const Pad& pad, std::size_t s, const T* params, const V3<T>* anchors,
                                    const std::uint8_t* anchored, const T& h = T(0)) {
  const std::size_t slot = pad.anchor < 0 ? 0 : pad.anchor + s * pad.cloud.size();
  return {params + pad.param, pad.law, DampingLaw::depth, T(0), anchors + slot, anchored + slot, 1, h};
}

// Which readings in an array may be other than zero: all, or those of these markers. Mostly few markers touch, and to
// clear them all costs more than to read those.
struct DirtyMarkers {
  bool all = true;
  bool track = true;  // whether the next reading says which they are: not worth it after one that felt many
  std::vector<int> markers;
};

// Three numbers each of four neighbours, x y z x y z …, from and to components apart.
template <class T>
GELFLOW_INLINE Vec3<SimdPack<T, 4>> load_threes(const T* from) {
  using P = SimdPack<T, 4>;
  const auto a = load<P>(from).v, b = load<P>(from + 4).v, c = load<P>(from + 8).v;
  const auto xy = __builtin_shufflevector(a, b, 0, 1, 6, 7), zx = __builtin_shufflevector(a, c, 2, 3, 4, 5),
             yz = __builtin_shufflevector(b, c, 0, 1, 6, 7);
  return {P(__builtin_shufflevector(xy, zx, 0, 5, 2, 7)), P(__builtin_shufflevector(xy, yz, 1, 4, 3, 6)),
          P(__builtin_shufflevector(zx, yz, 0, 5, 2, 7))};
}
template <class T>
GELFLOW_INLINE void store_threes(const Vec3<SimdPack<T, 4>>& a, T* to) {
  using P = SimdPack<T, 4>;
  const auto &x = a.x.v, &y = a.y.v, &z = a.z.v;
  const auto xy = __builtin_shufflevector(x, y, 0, 4, 2, 6), zx = __builtin_shufflevector(z, x, 0, 5, 2, 7),
             yz = __builtin_shufflevector(y, z, 1, 5, 3, 7);
  store(P(__builtin_shufflevector(xy, zx, 0, 1, 4, 5)), to);
  store(P(__builtin_shufflevector(yz, xy, 0, 1, 6, 7)), to + 4);
  store(P(__builtin_shufflevector(zx, yz, 2, 3, 6, 7)), to + 8);
}

// Four of eight numbers.
template <class T>
GELFLOW_INLINE SimdPack<T, 4> four(const SimdPack<T, 4>& x, int) {
  return x;
}
template <class T>
GELFLOW_INLINE SimdPack<T, 4> four(const SimdPack<T, 8>& x, int first) {
  return first == 0 ? SimdPack<T, 4>(__builtin_shufflevector(x.v, x.v, 0, 1, 2, 3))
                    : SimdPack<T, 4>(__builtin_shufflevector(x.v, x.v, 4, 5, 6, 7));
}
template <class T>
GELFLOW_INLINE void set_four(SimdPack<T, 4>& x, int, const SimdPack<T, 4>& value) {
  x = value;
}
template <class T>
GELFLOW_INLINE void set_four(SimdPack<T, 8>& x, int first, const SimdPack<T, 4>& value) {
  const auto& v = value.v;
  const auto both = __builtin_shufflevector(v, v, 0, 1, 2, 3, 0, 1, 2, 3);
  x = first == 0 ? SimdPack<T, 8>(__builtin_shufflevector(both, x.v, 0, 1, 2, 3, 12, 13, 14, 15))
                 : SimdPack<T, 8>(__builtin_shufflevector(x.v, both, 0, 1, 2, 3, 12, 13, 14, 15));
}

// Where the readings of one pad's markers stand in an array, in the order in which they were given.
template <class T, class Number>
class ReadingsView {
 public:
  using P = Pack<T>;
  ReadingsView(const Pad& pad, Number* all)
      : original_(pad.cloud.original.data()), numbers_(all + 3 * static_cast<std::ptrdiff_t>(pad.first_marker)) {}

  Number* operator[](int i) const { return at(original_[i]); }  // of marker i in the cloud

  // Of markers first + k in the cloud, for each bit k of `lanes`; those of others are 0, or stay.
  GELFLOW_INLINE Vec3<P> read(int first, unsigned lanes) const {
    Vec3<P> values = zero3<P>();
    if constexpr (packed) {
      for_fours(first, lanes, [&](int k, Number* from) GELFLOW_LOOP_BODY {
        const Vec3<SimdPack<T, 4>> part = load_threes<T>(from);
        for (int a = 0; a < 3; ++a) set_four(values[a], k, part[a]);
      });
    }
    for (; lanes != 0; lanes &= lanes - 1) {
      const int k = std::countr_zero(lanes);
      set_lane3<T>(values, k, Eigen::Map<const V3<T>>((*this)[first + k]));
    }
    return values;
  }
  GELFLOW_INLINE void write(int first, unsigned lanes, const Vec3<P>& values) const {
    if constexpr (packed) {
      for_fours(first, lanes, [&](int k, Number* to) GELFLOW_LOOP_BODY {
        store_threes<T>({four(values.x, k), four(values.y, k), four(values.z, k)}, to);
      });
    }
    if (lanes == 0) return;
    T apart[3][pack_width<T>];
    for (int a = 0; a < 3; ++a) store(values[a], apart[a]);
    for (; lanes != 0; lanes &= lanes - 1) {
      const int k = std::countr_zero(lanes);
      Number* const to = (*this)[first + k];
      for (int a = 0; a < 3; ++a) to[a] = apart[a][k];
    }
  }
  void clear(int begin, int end) const {
    for (int i = begin; i < end; ++i) std::fill_n((*this)[i], 3, T(0));
  }
  void clear_all(int markers) const { std::fill_n(numbers_, 3 * static_cast<std::ptrdiff_t>(markers), T(0)); }

 private:
  static constexpr bool packed = pack_width<T> % 4 == 0;
  Number* at(int marker) const { return numbers_ + 3 * static_cast<std::ptrdiff_t>(marker); }

  // Calls f(k, readings) for those fours that were neighbours from the start, and takes them out of `lanes`.
  template <class F>
  GELFLOW_INLINE void for_fours(int first, unsigned& lanes, F&& f) const {
    for (int k = 0; k < pack_width<T>; k += 4) {
      const int* const given = original_ + first + k;
      if (((lanes >> k) & 15U) != 15U || given[3] - given[0] != 3) continue;  // they go up
      f(k, at(given[0]));
      lanes &= ~(15U << k);
    }
  }
  const int* original_;
  Number* numbers_;
};

// Adds forces to the readings of a curved pad's markers, in their own frames: first + k for each bit k of `lanes`.
template <class T>
__attribute__((noinline)) void add_to_curved_pad(const Pad& pad, const PairFrame<T>& frame, int first, unsigned lanes,
                                                 const Vec3<Pack<T>>& force, const ReadingsView<T, T>& readings) {
  const Vec3<Pack<T>> in_body = transposed_times(broadcast<Pack<T>>(frame.rotation), force);
  for (; lanes != 0; lanes &= lanes - 1) {
    const int k = std::countr_zero(lanes);
    const V3<T> reading_force = pad.frames[first + k].transpose().template cast<T>() * lane3<T>(in_body, k);
    T* const reading = readings[first + k];
    reading[0] += reading_force[0];
    reading[1] += reading_force[1];
    reading[2] -= reading_force[2];
  }
}
template <class T>
__attribute__((noinline)) Vec3<Pack<T>> from_curved_pad(const Pad& pad, const PairFrame<T>& frame, int first,
                                                        unsigned lanes, const Vec3<Pack<T>>& reading_force) {
  Vec3<Pack<T>> in_body = zero3<Pack<T>>();
  for (; lanes != 0; lanes &= lanes - 1) {
    const int k = std::countr_zero(lanes);
    set_lane3<T>(in_body, k, pad.frames[first + k].template cast<T>() * lane3<T>(reading_force, k));
  }
  return broadcast<Pack<T>>(frame.rotation) * in_body;
}

// Readings of all markers, shape (markers, 3); needs the kinematics of (q, v) in w. `written`: what is not zero in `out`
// now, and then; null where nobody keeps account.
template <class T>
void read_markers(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                  const Workspace<T>& w, T* out, DirtyMarkers* dirty) {
  using P = Pack<T>;
  constexpr unsigned whole_pack = (1U << pack_width<T>)-1;
  const bool stale = dirty == nullptr || dirty->all;  // what is there must go, touched or not
  const bool track = dirty != nullptr && dirty->track;
  const int max_tracked = m.markers / 8;
  int active_markers = 0;  // markers
  if (dirty != nullptr) {
    for (const int marker : dirty->markers) std::fill_n(out + 3 * static_cast<std::size_t>(marker), 3, T(0));
    dirty->markers.clear();
    if (track) dirty->markers.reserve(static_cast<std::size_t>(max_tracked) + pack_width<T>);
  }
  const auto track_active = [&](const Pad& pad, const ContactPack<T>& t, unsigned active) GELFLOW_LOOP_BODY {
    active_markers += std::popcount(active);
    if (!track || active_markers > max_tracked) return;
    t.for_each_active([&](int, int i) { dirty->markers.push_back(pad.first_marker + pad.cloud.original[i]); });
  };
  for (const Pad& pad : m.pads) {
    const ReadingsView<T, T> readings(pad, out);
    bool is_clear = !stale;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const ContactSettings<T> settings = contact_settings<T>(pad, s, params, anchors, anchored);
      const Mat3<P> axes = broadcast<P>(M3<T>(frame.rotation * pad.frames[0].template cast<T>()));
      const CandidateRuns& candidates = candidate_runs<T>(frame, pad.cloud, settings.rolling_radius);
      if (!is_clear && (!pad.flat || 2 * candidates.points < pad.cloud.size())) {  // mostly, few are near
        readings.clear_all(pad.cloud.size());
        is_clear = true;
      }
      const bool first = s == 0, write_all = !is_clear;
      is_clear = true;
      const auto read = [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
        PointForce<P> force;
        point_force<false>(t.law, t.at, t.v, t.e, t.has_anchor, force);
        const unsigned active = bits(t.active);
        track_active(pad, t, active);
        if (!pad.flat) [[unlikely]] {
          const Vec3<P> in_shape = force.force;  // called, it needs a place in memory
          return add_to_curved_pad<T>(pad, frame, t.first, active, in_shape, readings);
        }
        Vec3<P> reading_force = transposed_times(axes, force.force);
        reading_force.z = -reading_force.z;
        if (first) {
          if (active == whole_pack || !write_all) return readings.write(t.first, active, reading_force);
          const unsigned there = whole_pack >> std::max(0, t.first + pack_width<T> - pad.cloud.size());
          readings.write(t.first, there, select3<P>(t.active, reading_force, zero3<P>()));
        } else {
          t.for_each_active([&](int k, int i) {
            T* const reading = readings[i];
            for (int a = 0; a < 3; ++a) reading[a] += lane(reading_force[a], k);
          });
        }
      };
      for_contact_points<false, T>(frame, pad.cloud, candidates, settings, read,
                                   [&](int begin, int end) GELFLOW_LOOP_BODY {
                                     if (write_all) readings.clear(begin, end);
                                   });
    }
    if (!is_clear) readings.clear_all(pad.cloud.size());  // no shape to feel
  }
  if (dirty == nullptr) return;
  dirty->track = active_markers <= max_tracked;
  dirty->all = !track || !dirty->track;
}

template <class T>
void advance_marker_anchors(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                            const std::uint8_t* anchored, Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0 || pad.pushes) continue;  // the anchors of its contacts have moved on
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      const ContactSettings<T> settings = contact_settings<T>(pad, s, params, anchors, anchored, h);
      find_candidate_points<T>(frame, pad.cloud, settings, CacheState::stale, w.marker_candidates);
      advance_anchors<T>(frame, w.marker_candidates, settings, pad.cloud.size(), next + slot, next_set + slot);
    }
  }
}

// Adds, to by_q, by_v and by_anchor, the gradient of readings with gradient `by_reading`, shape (markers, 3), at the
// state whose kinematics are in w. by_anchor may be null where there are no anchors.
template <class T>
void read_markers_vjp(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                      Workspace<T>& w, const T* by_reading, VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  using P = Pack<T>;
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      Vec3<P> turn = zero3<P>(), shift = turn, spin = turn, slide = turn;
      V3<T>* const by_own = pad.anchor < 0 ? nullptr : by_anchor + pad.anchor + s * pad.cloud.size();
      const ContactSettings<T> settings = contact_settings<T>(pad, s, params, anchors, anchored);
      const ReadingsView<T, const T> by_readings(pad, by_reading);
      const Mat3<P> axes = broadcast<P>(M3<T>(frame.rotation * pad.frames[0].template cast<T>()));
      for_contact_points<true, T>(frame, pad.cloud, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
        const unsigned active = bits(t.active);
        Vec3<P> by_force = by_readings.read(t.first, active);
        by_force.z = -by_force.z;
        if (pad.flat) [[likely]] {
          by_force = axes * by_force;
        } else {
          const Vec3<P> by_felt = by_force;  // called, it needs a place in memory
          const Vec3<P> values = from_curved_pad<T>(pad, frame, t.first, active, by_felt);
          for (int a = 0; a < 3; ++a) by_force[a] = values[a];
        }
        const PointGradient<P> g =
            point_force_vjp(t.law, t.at, t.v, t.e, t.has_anchor, by_force, by_force, zero3<P>(), zero3<P>());
        const Vec3<P> by_point = g.x - cross(broadcast<P>(frame.angular), g.v);
        turn += cross(t.x, by_point) + cross(by_force, g.force);  // the axes turn too
        shift += by_point;
        spin += cross(t.x, g.v);
        slide += g.v;
        if (by_own == nullptr) return;
        t.for_each_active([&](int k, int i) { by_own[i] += lane3<T>(g.anchor, k); });
      });
      const V6<T> by_pose = stack<T>(sum3<T>(turn), sum3<T>(shift)), by_twist = stack<T>(sum3<T>(spin), sum3<T>(slide));
      contact_jacobian<T>(pad.pairs[s], pad.mount.body, frame, w);
      pull_back<T>(w.jacobian, by_pose, by_twist, by_q, by_v);
    }
  }
}

// The same for the anchors' turn: gradients of the anchors after the step to the step's end and the anchors before.
template <class T>
void marker_anchors_vjp(const Model& m, const T* params, const T& h, const V3<T>* anchors, const std::uint8_t* anchored,
                        Workspace<T>& w, const V3<T>* by_next, VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  for (const Pad& pad : m.pads) {
    if (pad.anchor < 0 || pad.pushes) continue;
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      const PairFrame<T> frame = pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w);
      const std::size_t slot = pad.anchor + s * pad.cloud.size();
      V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
      anchors_vjp<T>(frame, pad.cloud, contact_settings<T>(pad, s, params, anchors, anchored, h), by_next + slot,
                     by_pose, by_twist, by_anchor + slot);
      contact_jacobian<T>(pad.pairs[s], pad.mount.body, frame, w);
      pull_back<T>(w.jacobian, by_pose, by_twist, by_q, by_v);
    }
  }
}

}  // namespace gelflow
