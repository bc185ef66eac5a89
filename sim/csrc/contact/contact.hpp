// Contact forces on the joints, and the anchors' turn at the end of a step.
//
// Per pair one wrench W on the first body (−W on the second) and two 6 × 6 blocks, K = ∂W/∂ξ and D = ∂W/∂V, are summed
// in the shape's frame and carried to the joints once. A point's displacement is ξ_lin + ξ_ang × c with c the point
// itself, or the sphere's centre for a rolling point. With A = ∂f/∂x where the twist moves along, B = ∂f/∂v:
//     D = Σ [x]×B | B   times  −[x]× | 1,      K = Σ [x]×A − [f]× | A   times  −[c]× | 1,     [f]×[c]× = c fᵀ − f·c
#pragma once

#include <algorithm>

#include "contact/arc_correction.hpp"
#include "contact/contact_jacobian.hpp"

namespace gelflow {

template <class T>
ContactSettings<T> contact_settings(const Model& m, const Contact& contact, const T* params, const V3<T>* anchors,
                                    const std::uint8_t* anchored, const T& h = T(0)) {
  const int slot = contact.anchor < 0 ? 0 : contact.anchor;
  const PointSet& set = m.point_sets[contact.points];
  // A sphere's size is its first scale; what has no radius need not have scales either (a pad that pushes).
  const T radius = set.radius > 0 ? T(T(set.radius) * params[set.mount.pose_param + 6]) : T(0);
  return {params + contact.param, contact.law, contact.damping, radius, anchors + slot, anchored + slot, 1, h};
}

// What all points of one pair feel: W about the shape's origin in its frame, and with derivatives K and D. Moments come
// before forces, turns before shifts.
template <class T>
struct ContactSums {
  static constexpr int outer_at = 6, k_at = 15, d_at = 51;
  T numbers[88];  // W (6), Σ x fᵀ (9), K and D (36 each), and one to make it whole packs
  const T* wrench() const { return numbers; }
  T outer(int i, int j) const { return numbers[outer_at + 3 * i + j]; }
  T& k(int i, int j) { return numbers[k_at + 6 * i + j]; }
  T k(int i, int j) const { return numbers[k_at + 6 * i + j]; }
  T d(int i, int j) const { return numbers[d_at + 6 * i + j]; }
};

// Packs of points whose forces are known and have yet to be summed.
template <class T>
struct ForceBuffer {
  using P = Pack<T>;
  static constexpr int capacity = 8;
  struct Entry {
    Vec3<P> x, force;
    Mat3<P> by_pose, by_v;  // A and B
  };
  int count = 0;
  Entry entry[capacity];
};

// Adds to a sum, or starts it.
template <bool first, class P>
GELFLOW_INLINE void accumulate(const P& value, P& sum) {
  sum = first ? value : sum + value;
}

// Adds what A (or B) is in `matrix` of all entries to a 6 × 6 matrix; c = x + lift ẑ. Each loop runs over all entries and
// keeps its few sums in registers.
template <bool first, class T>
GELFLOW_INLINE void add_blocks(const ForceBuffer<T>& buffer, Mat3<Pack<T>> ForceBuffer<T>::Entry::* matrix,
                               const T& lift, Pack<T>* out) {
  using P = Pack<T>;
  const P up(lift);
  for (int i = 0; i < 3; ++i) {
    Vec3<P> by_turn = zero3<P>(), by_shift = by_turn;
    for (int n = 0; n < buffer.count; ++n) {
      const auto& e = buffer.entry[n];
      const Vec3<P>& row = (e.*matrix).row[i];
      by_shift += row;
      by_turn += cross(Vec3<P>{e.x.x, e.x.y, e.x.z + up}, row);
    }
    for (int j = 0; j < 3; ++j) {
      accumulate<first>(by_turn[j], out[(3 + i) * 6 + j]);
      accumulate<first>(by_shift[j], out[(3 + i) * 6 + 3 + j]);
    }
  }
  const auto moments = [&](int j, auto&& turned) GELFLOW_LOOP_BODY {
    Vec3<P> by_turn = zero3<P>(), by_shift = by_turn;
    for (int n = 0; n < buffer.count; ++n) {
      const auto& e = buffer.entry[n];
      const Mat3<P>& a = e.*matrix;
      const Vec3<P> c{e.x.x, e.x.y, e.x.z + up};
      by_shift += cross(e.x, Vec3<P>{a.row[0][j], a.row[1][j], a.row[2][j]});
      by_turn += cross(e.x, Vec3<P>{turned(c, a.row[0]), turned(c, a.row[1]), turned(c, a.row[2])});
    }
    for (int i = 0; i < 3; ++i) {
      accumulate<first>(by_turn[i], out[i * 6 + j]);
      accumulate<first>(by_shift[i], out[i * 6 + 3 + j]);
    }
  };
  using V = Vec3<P>;
  moments(0, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.y * r.z - c.z * r.y; });
  moments(1, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.z * r.x - c.x * r.z; });
  moments(2, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.x * r.y - c.y * r.x; });
}

// Adds all entries to the sums, or starts these, which lie as in ContactSums; K without what the forces themselves add.
template <bool first, bool derivatives, class T>
__attribute__((noinline)) void flush(ForceBuffer<T>& buffer, const T& lift, Pack<T>* sums) {
  using P = Pack<T>;
  Vec3<P> force = zero3<P>(), moment = force;
  for (int n = 0; n < buffer.count; ++n) {
    const auto& e = buffer.entry[n];
    force += e.force;
    moment += cross(e.x, e.force);
  }
  for (int i = 0; i < 3; ++i) {
    accumulate<first>(moment[i], sums[i]);
    accumulate<first>(force[i], sums[3 + i]);
  }
  if constexpr (derivatives) {
    Mat3<P> outer_sum = zero33<P>();
    for (int n = 0; n < buffer.count; ++n) outer_sum += outer(buffer.entry[n].x, buffer.entry[n].force);
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) accumulate<first>(outer_sum.row[i][j], sums[ContactSums<T>::outer_at + 3 * i + j]);
    }
    add_blocks<first, T>(buffer, &ForceBuffer<T>::Entry::by_pose, lift, sums + ContactSums<T>::k_at);
    add_blocks<first, T>(buffer, &ForceBuffer<T>::Entry::by_v, T(0), sums + ContactSums<T>::d_at);
  }
  buffer.count = 0;
}

// Sums over the points near the shape. Returns whether any of them touches.
template <bool derivatives, class T>
bool sum_forces(const PairFrame<T>& frame, const CandidatePoints<T>& candidates, const ContactSettings<T>& settings,
                ContactSums<T>& sums) {
  using P = Pack<T>;
  constexpr int numbers = derivatives ? 87 : 6, packed = derivatives ? 88 : 8;
  P all[packed];
  for (int i = numbers; i < packed; ++i) all[i] = P(0.0);
  bool started = false;
  ForceBuffer<T> buffer;
  const auto add = [&]() GELFLOW_LOOP_BODY {
    if (started) {
      flush<false, derivatives, T>(buffer, settings.rolling_radius, all);
    } else {
      flush<true, derivatives, T>(buffer, settings.rolling_radius, all);
    }
    started = true;
  };
  for_contact_points<derivatives, T>(frame, candidates, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    PointForce<P> force;
    point_force<derivatives>(t.law, t.at, t.v, t.e, t.has_anchor, force);
    auto& e = buffer.entry[buffer.count++];
    e.x = t.x;
    e.force = force.force;
    if constexpr (derivatives) {
      e.by_pose = force.by_x + cross_rows(force.by_v, broadcast<P>(frame.angular));
      e.by_v = force.by_v;
    }
    if (buffer.count == ForceBuffer<T>::capacity) add();
  });
  if (buffer.count > 0) add();
  if (!started) return false;
  sum_lanes(all, packed, sums.numbers);
  if constexpr (derivatives) {
    const T* const f = sums.wrench() + 3;
    const T lift = settings.rolling_radius;
    const T work = sums.outer(0, 0) + sums.outer(1, 1) + sums.outer(2, 2) + lift * f[2];  // Σ f·c
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) sums.k(i, j) += sums.outer(i, j);
      sums.k(2, i) += lift * f[i];
      sums.k(i, i) -= work;
      const int j = (i + 1) % 3, k = (i + 2) % 3;  // −[f]×
      sums.k(j, 3 + k) += f[i];
      sums.k(k, 3 + j) -= f[i];
    }
  }
  return true;
}

// Subtracts h · (what the pair's sums say) from w.by_q and w.by_v.
template <class T>
void subtract_contact_derivatives(const T& h, const ContactSums<T>& sums, Workspace<T>& w) {
  using P = Pack<T>;
  constexpr int width = pack_width<T>;
  ContactJacobian<T>& c = w.jacobian;
  for (int i = 0; i < c.n; i += width) {  // what the displacement of these dofs changes
    P s[6], y[6];
    for (int a = 0; a < 6; ++a) {
      s[a] = load<P>(c.s.at(i, a));
      y[a] = load<P>(c.y.at(i, a));
    }
    for (int a = 0; a < 6; ++a) {
      P by_q = P(sums.k(a, 0)) * s[0] + P(sums.d(a, 0)) * y[0], by_v = P(sums.d(a, 0)) * s[0];
      for (int b = 1; b < 6; ++b) {
        const P d(sums.d(a, b));
        by_q += P(sums.k(a, b)) * s[b] + d * y[b];
        by_v += d * s[b];
      }
      store(by_q, c.force_q.at(i, a));
      store(by_v, c.force_v.at(i, a));
    }
    // S_j ×* W: −(S_j ×* W) where j moves the first body, + where it moves the second; s_j S_j carries the sign.
    const T* const f = sums.wrench();
    const Vec3<P> turn{s[0], s[1], s[2]}, shift{s[3], s[4], s[5]}, moment{P(f[0]), P(f[1]), P(f[2])},
        force{P(f[3]), P(f[4]), P(f[5])};
    const Vec3<P> top = cross(turn, moment) + cross(shift, force), bottom = cross(turn, force);
    for (int a = 0; a < 3; ++a) {
      store(top[a], c.axis_wrench.at(i, a));
      store(bottom[a], c.axis_wrench.at(i, 3 + a));
    }
  }
  // `from`: 3 for a row without an angular part; `carried`: some of its axes are.
  const auto add_row = [&](int r, auto from, auto carried) GELFLOW_LOOP_BODY {
    const int row = c.dofs->dof[r];
    P s[6];
    for (int a = from; a < 6; ++a) s[a] = P(T(h * c.s.at(r - r % width, a)[r % width]));
    for (int i = 0; i < c.n; i += width) {
      P by_q(0.0), by_v(0.0), turned(0.0);
      for (int a = from; a < 6; ++a) {
        by_q += s[a] * load<P>(c.force_q.at(i, a));
        by_v += s[a] * load<P>(c.force_v.at(i, a));
        if (carried) turned += s[a] * load<P>(c.axis_wrench.at(i, a));
      }
      if (carried) by_q -= load<P>(&c.dofs->axis_coupling[static_cast<std::size_t>(r) * c.n + i]) * turned;
      const std::ptrdiff_t at = row * w.by_q.outerStride() + c.dofs->start[i / width];
      store(load<P>(w.by_q.data() + at) - by_q, w.by_q.data() + at);
      store(load<P>(w.by_v.data() + at) - by_v, w.by_v.data() + at);
    }
  };
  using All = std::integral_constant<int, 0>;
  using Linear = std::integral_constant<int, 3>;
  for (int r = 0; r < c.n; ++r) {
    if (c.dofs->dof[r] < 0) continue;
    if (!c.dofs->linear[r]) {
      add_row(r, All(), std::true_type());
    } else if (c.dofs->has_coupling[r]) {
      add_row(r, Linear(), std::true_type());
    } else {
      add_row(r, Linear(), std::false_type());
    }
  }
}

// A wrench about the shape's origin in its frame as one about the world's origin.
template <class T>
V6<T> wrench_in_world(const PairFrame<T>& frame, const T* wrench) {
  const V3<T> moment = frame.to_world * vec3(wrench), push = frame.to_world * vec3(wrench + 3);
  return stack<T>(moment + cross<T>(frame.origin, push), push);
}

// Subtracts the impulses h · (the pair's wrench) from w.residual. `scale`: adds their size to w.forces.
template <class T>
void subtract_impulses(const PairDofs& pair, const T& h, const V6<T>& wrench, bool add_impulses, Workspace<T>& w) {
  using std::abs;
  using P = Pack<T>;
  constexpr int width = pack_width<T>;
  const PackedDofs& dofs = pair.packed<width>();
  for (std::size_t n = 0; n < dofs.start.size(); ++n) {
    const int at = dofs.start[n];
    P sum = P(wrench[0]) * load<P>(w.axis.row(0) + at);
    for (int a = 1; a < 6; ++a) sum += P(wrench[a]) * load<P>(w.axis.row(a) + at);
    T impulse[width];
    store(P(h) * load<P>(&dofs.sign[n * width]) * sum, impulse);
    for (int k = 0; k < width; ++k) {
      const int dof = dofs.dof[n * width + k];
      if (dof < 0) continue;
      w.residual[dof] -= impulse[k];
      if (add_impulses) w.impulses[dof] += abs(impulse[k]);
    }
  }
}

// Subtracts h · (contact forces) from w.residual; with derivatives also from w.by_q and w.by_v. `found`: what the
// workspace was last used for. `scale`: adds the impulses' size to w.forces.
template <bool derivatives, class T>
void subtract_contact_forces(const Model& m, const T* params, const StepStart<T>& from, CacheState cache,
                             bool add_impulses, Workspace<T>& w) {
  ContactSums<T> sums;
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    ContactSettings<T> settings = contact_settings<T>(m, contact, params, from.anchors, from.anchored, from.h);
    settings.continuation = from.continuation;
    find_candidate_points<T>(frame, set.cloud, settings, cache, w.candidates[n]);
    if (!sum_forces<derivatives, T>(frame, w.candidates[n], settings, sums)) {
      if (!is_finite(frame.finiteness_probe())) w.residual[0] = frame.finiteness_probe();
      continue;
    }
    subtract_impulses<T>(contact.pair, from.h, wrench_in_world<T>(frame, sums.wrench()), add_impulses, w);
    if constexpr (derivatives) {
      contact_jacobian<T>(contact.pair, set.mount.body, frame, w);
      subtract_contact_derivatives<T>(from.h, sums, w);
    }
    if (contact.uses_arc_correction && from.history == nullptr) {
      subtract_arc_correction<derivatives, T>(m, set.mount.body, frame, w.candidates[n], settings, w);
    }
  }
}

// Wrench of every contact on its first body, about the world's origin: (moment, force), shape (contacts, 6). Needs the
// kinematics of (q, v) in w.
template <class T>
void contact_wrenches(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                      Workspace<T>& w, T* out) {
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    const ContactSettings<T> settings = contact_settings<T>(m, contact, params, anchors, anchored);
    ContactSums<T> sums;
    find_candidate_points<T>(frame, set.cloud, settings, CacheState::stale, w.candidates[n]);
    if (!sum_forces<false, T>(frame, w.candidates[n], settings, sums)) std::fill_n(sums.numbers, 6, T(0));
    const V6<T> in_world = wrench_in_world<T>(frame, sums.wrench());
    for (int i = 0; i < 6; ++i) out[6 * n + i] = in_world[i];
  }
}

// Anchors after an accepted step, the last that was evaluated in w. `next` and `next_set` may be the arrays that are read.
template <class T>
void advance_contact_anchors(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                             const std::uint8_t* anchored, Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    if (contact.anchor < 0) continue;
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    advance_anchors<T>(frame, w.candidates[n], contact_settings<T>(m, contact, params, anchors, anchored, h),
                       set.cloud.size(), next + contact.anchor, next_set + contact.anchor);
  }
}

// The reverse pass of the anchors. First call (`from_next`): gradients of the anchors after the step go to the state at
// the step's end (by_q, by_v) and to the anchors before (by_anchor). Second call, with c the multipliers of the residual:
// what the residual says of the anchors before. `second`: the step was one of BDF2.
template <bool from_next, class T>
void contact_anchors_vjp(const Model& m, const T* params, const T& h, bool bdf2, const V3<T>* anchors,
                         const std::uint8_t* anchored, Workspace<T>& w, const V3<T>* by_next, const VX<T>& multipliers,
                         VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  using P = Pack<T>;
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    if (contact.anchor < 0) continue;
    const Mount& first = m.point_sets[contact.points].mount;
    const PairFrame<T> frame = pair_frame<T>(params, first, m.shapes[contact.shape], w);
    contact_jacobian<T>(contact.pair, first.body, frame, w);
    V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
    const ContactSettings<T> settings = contact_settings<T>(m, contact, params, anchors, anchored, h);
    V3<T>* const by_own = by_anchor + contact.anchor;
    if constexpr (from_next) {
      anchors_vjp<T>(frame, w.candidates[n], settings, by_next + contact.anchor, by_pose, by_twist, by_own);
      pull_back<T>(w.jacobian, by_pose, by_twist, by_q, by_v);
    } else {
      V6<T> virtual_twist = V6<T>::Zero();
      const ContactJacobian<T>& c = w.jacobian;
      for (int i = 0; i < c.n; ++i) {
        if (c.dofs->dof[i] >= 0) virtual_twist += c.s[i] * multipliers[c.dofs->dof[i]];
      }
      const bool arc = contact.uses_arc_correction && !bdf2;
      const Mat3<P> arm =
          broadcast<P>(arc ? MomentArmCorrection<T>(h * frame.angular, false).value : M3<T>(M3<T>::Zero()));
      const Vec3<P> origin = broadcast<P>(arc ? body_origin_in_shape<T>(frame, first.body, w) : V3<T>(V3<T>::Zero()));
      const Vec3<P> spin = broadcast<P>(V3<T>(top(virtual_twist))), slide = broadcast<P>(V3<T>(bottom(virtual_twist)));
      for_contact_points<true, T>(frame, w.candidates[n], settings, [&](const ContactPack<T>& t) {
        const Vec3<P> on_friction = P(h) * (slide + cross(spin, t.x)), none = zero3<P>();
        const Vec3<P> on_spring =
            P(h) * cross(spin, arm * (t.center - origin));  // −k_s s = k_t v_t + q f_t + (1 − q) f*
        const P q = relaxation_factor(t.law, P(h));
        const Vec3<P> by = point_force_vjp(t.law, t.at, t.v, t.e, t.has_anchor, none, on_friction + q * on_spring,
                                           (P(1.0) - q) * on_spring, none)
                               .anchor;
        t.for_each_active([&](int k, int i) { by_own[i] += lane3<T>(by, k); });
      });
    }
  }
}

}  // namespace gelflow
