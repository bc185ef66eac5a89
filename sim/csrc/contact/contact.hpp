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
TouchRule<T> touch_rule(const Model& m, const Contact& contact, const T* params, const V3<T>* anchors,
                        const std::uint8_t* anchored, const T& h = T(0)) {
  const int slot = contact.anchor < 0 ? 0 : contact.anchor;
  const PointSet& set = m.point_sets[contact.points];
  // A sphere's size is its first scale; what has no radius need not have scales either (a pad that pushes).
  const T radius = set.radius > 0 ? T(T(set.radius) * params[set.mount.place + 6]) : T(0);
  return {params + contact.param, contact.law, contact.damping, radius, anchors + slot, anchored + slot, 1, h};
}

// What all points of one pair feel: W about the shape's origin in its frame, and with derivatives K and D. Moments come
// before forces, turns before shifts.
template <class T>
struct PairSums {
  static constexpr int spread_at = 6, k_at = 15, d_at = 51;
  T numbers[88];  // W (6), Σ x fᵀ (9), K and D (36 each), and one to make it whole packs
  const T* wrench() const { return numbers; }
  T spread(int i, int j) const { return numbers[spread_at + 3 * i + j]; }
  T& k(int i, int j) { return numbers[k_at + 6 * i + j]; }
  T k(int i, int j) const { return numbers[k_at + 6 * i + j]; }
  T d(int i, int j) const { return numbers[d_at + 6 * i + j]; }
};

// Packs of points whose forces are known and have yet to be summed.
template <class T>
struct Pending {
  using L = Pack<T>;
  static constexpr int most = 8;
  struct Entry {
    Vec3<L> x, force;
    Mat3<L> by_pose, by_v;  // A and B
  };
  int count = 0;
  Entry entry[most];
};

// Adds to a sum, or starts it.
template <bool first, class L>
GELFLOW_INLINE void put(const L& value, L& sum) {
  sum = first ? value : sum + value;
}

// Adds what A (or B) is in `matrix` of all entries to a 6 × 6 matrix; c = x + lift ẑ. Each loop runs over all entries and
// keeps its few sums in registers.
template <bool first, class T>
GELFLOW_INLINE void add_blocks(const Pending<T>& pending, Mat3<Pack<T>> Pending<T>::Entry::* matrix, const T& lift,
                               Pack<T>* out) {
  using L = Pack<T>;
  const L up(lift);
  for (int i = 0; i < 3; ++i) {
    Vec3<L> by_turn = zero3<L>(), by_shift = by_turn;
    for (int n = 0; n < pending.count; ++n) {
      const auto& e = pending.entry[n];
      const Vec3<L>& row = (e.*matrix).row[i];
      by_shift += row;
      by_turn += cross(Vec3<L>{e.x.x, e.x.y, e.x.z + up}, row);
    }
    for (int j = 0; j < 3; ++j) {
      put<first>(by_turn[j], out[(3 + i) * 6 + j]);
      put<first>(by_shift[j], out[(3 + i) * 6 + 3 + j]);
    }
  }
  const auto moments = [&](int j, auto&& turned) GELFLOW_LOOP_BODY {
    Vec3<L> by_turn = zero3<L>(), by_shift = by_turn;
    for (int n = 0; n < pending.count; ++n) {
      const auto& e = pending.entry[n];
      const Mat3<L>& a = e.*matrix;
      const Vec3<L> c{e.x.x, e.x.y, e.x.z + up};
      by_shift += cross(e.x, Vec3<L>{a.row[0][j], a.row[1][j], a.row[2][j]});
      by_turn += cross(e.x, Vec3<L>{turned(c, a.row[0]), turned(c, a.row[1]), turned(c, a.row[2])});
    }
    for (int i = 0; i < 3; ++i) {
      put<first>(by_turn[i], out[i * 6 + j]);
      put<first>(by_shift[i], out[i * 6 + 3 + j]);
    }
  };
  using V = Vec3<L>;
  moments(0, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.y * r.z - c.z * r.y; });
  moments(1, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.z * r.x - c.x * r.z; });
  moments(2, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.x * r.y - c.y * r.x; });
}

// Adds all entries to the sums, or starts these, which lie as in PairSums; K without what the forces themselves add.
template <bool first, bool derivatives, class T>
__attribute__((noinline)) void add_pending(Pending<T>& pending, const T& lift, Pack<T>* sums) {
  using L = Pack<T>;
  Vec3<L> force = zero3<L>(), moment = force;
  for (int n = 0; n < pending.count; ++n) {
    const auto& e = pending.entry[n];
    force += e.force;
    moment += cross(e.x, e.force);
  }
  for (int i = 0; i < 3; ++i) {
    put<first>(moment[i], sums[i]);
    put<first>(force[i], sums[3 + i]);
  }
  if constexpr (derivatives) {
    Mat3<L> spread = zero33<L>();
    for (int n = 0; n < pending.count; ++n) spread += outer(pending.entry[n].x, pending.entry[n].force);
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) put<first>(spread.row[i][j], sums[PairSums<T>::spread_at + 3 * i + j]);
    }
    add_blocks<first, T>(pending, &Pending<T>::Entry::by_pose, lift, sums + PairSums<T>::k_at);
    add_blocks<first, T>(pending, &Pending<T>::Entry::by_v, T(0), sums + PairSums<T>::d_at);
  }
  pending.count = 0;
}

// Sums over the points near the shape. Returns whether any of them touches.
template <bool derivatives, class T>
bool sum_forces(const PairFrame<T>& frame, const NearPoints<T>& near, const TouchRule<T>& rule, PairSums<T>& sums) {
  using L = Pack<T>;
  constexpr int numbers = derivatives ? 87 : 6, packed = derivatives ? 88 : 8;
  L all[packed];
  for (int i = numbers; i < packed; ++i) all[i] = L(0.0);
  bool started = false;
  Pending<T> pending;
  const auto add = [&]() GELFLOW_LOOP_BODY {
    if (started) {
      add_pending<false, derivatives, T>(pending, rule.rolling_radius, all);
    } else {
      add_pending<true, derivatives, T>(pending, rule.rolling_radius, all);
    }
    started = true;
  };
  for_touching_points<derivatives, T>(frame, near, rule, [&](const Touching<T>& t) GELFLOW_LOOP_BODY {
    PointForce<L> force;
    point_force<derivatives>(t.law, t.at, t.v, t.e, t.remembers, force);
    auto& e = pending.entry[pending.count++];
    e.x = t.x;
    e.force = force.force;
    if constexpr (derivatives) {
      e.by_pose = force.by_x + cross_rows(force.by_v, spread<L>(frame.angular));
      e.by_v = force.by_v;
    }
    if (pending.count == Pending<T>::most) add();
  });
  if (pending.count > 0) add();
  if (!started) return false;
  sum_lanes(all, packed, sums.numbers);
  if constexpr (derivatives) {
    const T* const f = sums.wrench() + 3;
    const T lift = rule.rolling_radius;
    const T work = sums.spread(0, 0) + sums.spread(1, 1) + sums.spread(2, 2) + lift * f[2];  // Σ f·c
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) sums.k(i, j) += sums.spread(i, j);
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
void subtract_derivatives(const T& h, const PairSums<T>& sums, Workspace<T>& w) {
  using L = Pack<T>;
  constexpr int width = pack_width<T>;
  PairColumns<T>& c = w.columns;
  for (int i = 0; i < c.n; i += width) {  // what the displacement of these dofs changes
    L s[6], y[6];
    for (int a = 0; a < 6; ++a) {
      s[a] = load<L>(c.s.at(i, a));
      y[a] = load<L>(c.y.at(i, a));
    }
    for (int a = 0; a < 6; ++a) {
      L by_q = L(sums.k(a, 0)) * s[0] + L(sums.d(a, 0)) * y[0], by_v = L(sums.d(a, 0)) * s[0];
      for (int b = 1; b < 6; ++b) {
        const L d(sums.d(a, b));
        by_q += L(sums.k(a, b)) * s[b] + d * y[b];
        by_v += d * s[b];
      }
      store(by_q, c.force_q.at(i, a));
      store(by_v, c.force_v.at(i, a));
    }
    // S_j ×* W: −(S_j ×* W) where j moves the first body, + where it moves the second; s_j S_j carries the sign.
    const T* const f = sums.wrench();
    const Vec3<L> turn{s[0], s[1], s[2]}, shift{s[3], s[4], s[5]}, moment{L(f[0]), L(f[1]), L(f[2])},
        force{L(f[3]), L(f[4]), L(f[5])};
    const Vec3<L> top = cross(turn, moment) + cross(shift, force), bottom = cross(turn, force);
    for (int a = 0; a < 3; ++a) {
      store(top[a], c.turned.at(i, a));
      store(bottom[a], c.turned.at(i, 3 + a));
    }
  }
  // `from`: 3 for a row without an angular part; `carried`: some of its axes are.
  const auto add_row = [&](int r, auto from, auto carried) GELFLOW_LOOP_BODY {
    const int row = c.dofs->dof[r];
    L s[6];
    for (int a = from; a < 6; ++a) s[a] = L(T(h * c.s.at(r - r % width, a)[r % width]));
    for (int i = 0; i < c.n; i += width) {
      L by_q(0.0), by_v(0.0), turned(0.0);
      for (int a = from; a < 6; ++a) {
        by_q += s[a] * load<L>(c.force_q.at(i, a));
        by_v += s[a] * load<L>(c.force_v.at(i, a));
        if (carried) turned += s[a] * load<L>(c.turned.at(i, a));
      }
      if (carried) by_q -= load<L>(&c.dofs->turned[static_cast<std::size_t>(r) * c.n + i]) * turned;
      const std::ptrdiff_t at = row * w.by_q.outerStride() + c.dofs->start[i / width];
      store(load<L>(w.by_q.data() + at) - by_q, w.by_q.data() + at);
      store(load<L>(w.by_v.data() + at) - by_v, w.by_v.data() + at);
    }
  };
  using All = std::integral_constant<int, 0>;
  using Linear = std::integral_constant<int, 3>;
  for (int r = 0; r < c.n; ++r) {
    if (c.dofs->dof[r] < 0) continue;
    if (!c.dofs->slides[r]) {
      add_row(r, All(), std::true_type());
    } else if (c.dofs->carried[r]) {
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
void subtract_impulses(const PairDofs& pair, const T& h, const V6<T>& wrench, bool scale, Workspace<T>& w) {
  using std::abs;
  using L = Pack<T>;
  constexpr int width = pack_width<T>;
  const PackedDofs& dofs = pair.packed<width>();
  for (std::size_t n = 0; n < dofs.start.size(); ++n) {
    const int at = dofs.start[n];
    L sum = L(wrench[0]) * load<L>(w.axis.row(0) + at);
    for (int a = 1; a < 6; ++a) sum += L(wrench[a]) * load<L>(w.axis.row(a) + at);
    T impulse[width];
    store(L(h) * load<L>(&dofs.sign[n * width]) * sum, impulse);
    for (int k = 0; k < width; ++k) {
      const int dof = dofs.dof[n * width + k];
      if (dof < 0) continue;
      w.residual[dof] -= impulse[k];
      if (scale) w.forces[dof] += abs(impulse[k]);
    }
  }
}

// Subtracts h · (contact forces) from w.residual; with derivatives also from w.by_q and w.by_v. `found`: what the
// workspace was last used for. `scale`: adds the impulses' size to w.forces.
template <bool derivatives, class T>
void subtract_contact_forces(const Model& m, const T* params, const StepStart<T>& from, Found found, bool scale,
                             Workspace<T>& w) {
  PairSums<T> sums;
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    TouchRule<T> rule = touch_rule<T>(m, contact, params, from.anchors, from.anchored, from.h);
    rule.softness = from.softness;
    find_near_points<T>(frame, set.cloud, rule, found, w.near[n]);
    if (!sum_forces<derivatives, T>(frame, w.near[n], rule, sums)) {
      if (!is_finite(frame.check())) w.residual[0] = frame.check();
      continue;
    }
    subtract_impulses<T>(contact.pair, from.h, wrench_in_world<T>(frame, sums.wrench()), scale, w);
    if constexpr (derivatives) {
      pair_columns<T>(contact.pair, set.mount.body, frame, w);
      subtract_derivatives<T>(from.h, sums, w);
    }
    if (contact.on_arc && from.history == nullptr) {
      subtract_arc_moments<derivatives, T>(m, set.mount.body, frame, w.near[n], rule, w);
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
    const TouchRule<T> rule = touch_rule<T>(m, contact, params, anchors, anchored);
    PairSums<T> sums;
    find_near_points<T>(frame, set.cloud, rule, Found::elsewhere, w.near[n]);
    if (!sum_forces<false, T>(frame, w.near[n], rule, sums)) std::fill_n(sums.numbers, 6, T(0));
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
    advance_anchors<T>(frame, w.near[n], touch_rule<T>(m, contact, params, anchors, anchored, h), set.cloud.size(),
                       next + contact.anchor, next_set + contact.anchor);
  }
}

// The reverse pass of the anchors. First call (`from_next`): gradients of the anchors after the step go to the state at
// the step's end (by_q, by_v) and to the anchors before (by_anchor). Second call, with c the multipliers of the residual:
// what the residual says of the anchors before. `second`: the step was one of BDF2.
template <bool from_next, class T>
void contact_anchors_transposed(const Model& m, const T* params, const T& h, bool second, const V3<T>* anchors,
                                const std::uint8_t* anchored, Workspace<T>& w, const V3<T>* by_next,
                                const VX<T>& multipliers, VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  using L = Pack<T>;
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    if (contact.anchor < 0) continue;
    const Mount& first = m.point_sets[contact.points].mount;
    const PairFrame<T> frame = pair_frame<T>(params, first, m.shapes[contact.shape], w);
    pair_columns<T>(contact.pair, first.body, frame, w);
    V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
    const TouchRule<T> rule = touch_rule<T>(m, contact, params, anchors, anchored, h);
    V3<T>* const by_own = by_anchor + contact.anchor;
    if constexpr (from_next) {
      anchors_transposed<T>(frame, w.near[n], rule, by_next + contact.anchor, by_pose, by_twist, by_own);
      pull_back<T>(w.columns, by_pose, by_twist, by_q, by_v);
    } else {
      V6<T> virtual_twist = V6<T>::Zero();
      const PairColumns<T>& c = w.columns;
      for (int i = 0; i < c.n; ++i) {
        if (c.dofs->dof[i] >= 0) virtual_twist += c.s[i] * multipliers[c.dofs->dof[i]];
      }
      const bool arc = contact.on_arc && !second;
      const Mat3<L> lever = spread<L>(arc ? ArcLever<T>(h * frame.angular, false).value : M3<T>(M3<T>::Zero()));
      const Vec3<L> origin = spread<L>(arc ? origin_in<T>(frame, first.body, w) : V3<T>(V3<T>::Zero()));
      const Vec3<L> spin = spread<L>(V3<T>(top(virtual_twist))), slide = spread<L>(V3<T>(bottom(virtual_twist)));
      for_touching_points<true, T>(frame, w.near[n], rule, [&](const Touching<T>& t) {
        const Vec3<L> on_friction = L(h) * (slide + cross(spin, t.x)), none = zero3<L>();
        const Vec3<L> on_spring =
            L(h) * cross(spin, lever * (t.center - origin));  // −k_s s = k_t v_t + q f_t + (1 − q) f*
        const L q = yielding(t.law, L(h));
        const Vec3<L> by = point_force_transposed(t.law, t.at, t.v, t.e, t.remembers, none, on_friction + q * on_spring,
                                                  (L(1.0) - q) * on_spring, none)
                               .anchor;
        t.for_each_inside([&](int k, int i) { by_own[i] += lane3<T>(by, k); });
      });
    }
  }
}

}  // namespace gelflow
