// Contact forces on the joints, and the anchors' turn at the end of a step.
//
// Per pair one wrench W on the first body (−W on the second) and two 6 × 6 blocks, K = ∂W/∂ξ and D = ∂W/∂V, are summed
// in the shape's frame and carried to the joints once. A point's displacement is ξ_lin + ξ_ang × c with c the point
// itself, or the sphere's centre for a rolling point.
#pragma once

#include "pair.hpp"

namespace gelflow {

template <class T>
TouchRule<T> touch_rule(const Model& m, const Contact& contact, const T* params, const V3<T>* anchors,
                        const std::uint8_t* anchored) {
  const int slot = contact.anchor < 0 ? 0 : contact.anchor;
  const PointSet& set = m.point_sets[contact.points];
  // A sphere's size is its first scale; what has no radius need not have scales either (a pad that pushes).
  const T radius = set.radius > 0 ? T(T(set.radius) * params[set.mount.place + 6]) : T(0);
  return {params + contact.param, contact.law, contact.damping, radius, anchors + slot, anchored + slot};
}

// The wrench of all touching points on the first body, about the shape's origin in its frame, and with derivatives the
// blocks of K and D (mm, mf, fm, ff of each). Returns whether any point touches.
template <bool derivatives, class T>
bool sum_forces(const PairFrame<T>& frame, const PointCloud& cloud, const TouchRule<T>& rule, V6<T>& wrench,
                const std::array<M3<T>*, 8>& blocks) {
  using L = Pack<T>;
  Vec3<L> moment_sum = zero3<L>(), force_sum = zero3<L>();
  Mat3<L> sums[8];
  if constexpr (derivatives) std::fill(sums, sums + 8, zero33<L>());
  bool touching = false;
  for_touching_points<T>(frame, cloud, rule, [&](const Touching<T>& t) {
    touching = true;
    PointForce<L> force;
    point_force<derivatives ? 1 : 0>(t.law, t.at, t.v, t.e, t.remembers, force);
    moment_sum += cross(t.x, force.force);
    force_sum += force.force;
    if constexpr (derivatives) {
      const Mat3<L> a = force.by_x + cross_rows(force.by_v, spread<L>(frame.angular));
      Mat3<L> moment = cross_columns(t.x, a);  // − [f]×
      moment.row[0] += Vec3<L>{L(0.0), force.force.z, -force.force.y};
      moment.row[1] += Vec3<L>{-force.force.z, L(0.0), force.force.x};
      moment.row[2] += Vec3<L>{force.force.y, -force.force.x, L(0.0)};
      const Mat3<L> moment_v = cross_columns(t.x, force.by_v);
      sums[0] -= cross_rows(moment, t.center);
      sums[1] += moment;
      sums[2] -= cross_rows(a, t.center);
      sums[3] += a;
      sums[4] -= cross_rows(moment_v, t.x);
      sums[5] += moment_v;
      sums[6] -= cross_rows(force.by_v, t.x);
      sums[7] += force.by_v;
    }
  });
  if (!touching) return false;
  wrench = stack<T>(sum3<T>(moment_sum), sum3<T>(force_sum));
  if constexpr (derivatives) {
    for (int i = 0; i < 8; ++i) *blocks[i] = sum33<T>(sums[i]);
  }
  return true;
}

// Subtracts h · (contact forces) from w.residual; with derivatives also from w.by_q and w.by_v. `scale`: adds the
// impulses' size to w.forces.
template <bool derivatives, class T>
void subtract_contact_forces(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                             const std::uint8_t* anchored, double softness, bool scale, Workspace<T>& w) {
  using std::abs;
  PairColumns<T> c;
  for (const Contact& contact : m.contacts) {
    const Shape& shape = m.shapes[contact.shape];
    const Mount& first = m.point_sets[contact.points].mount;
    const PairFrame<T> frame = pair_frame<T>(params, first, shape, w);
    V6<T> wrench = V6<T>::Zero();
    // The blocks of K and D: rows moment, force; columns turn, shift.
    M3<T> k_mm, k_mf, k_fm, k_ff, d_mm, d_mf, d_fm, d_ff;
    TouchRule<T> rule = touch_rule<T>(m, contact, params, anchors, anchored);
    rule.softness = softness;
    const bool touching = sum_forces<derivatives, T>(frame, m.point_sets[contact.points].cloud, rule, wrench,
                                                     {&k_mm, &k_mf, &k_fm, &k_ff, &d_mm, &d_mf, &d_fm, &d_ff});
    if (!touching) {
      if (!is_finite(frame.check())) w.residual[0] = frame.check();
      continue;
    }
    pair_columns<derivatives, T>(contact.pair, first.body, frame, w, c);
    for (int i = 0; i < c.n; ++i) {
      const T force_i = c.s[i].dot(wrench);
      w.residual[contact.pair.dof[i]] -= h * force_i;
      if (scale) w.forces[contact.pair.dof[i]] += h * abs(force_i);
    }
    if constexpr (derivatives) {
      M6<T> k, d;
      k.template topLeftCorner<3, 3>() = k_mm;
      k.template topRightCorner<3, 3>() = k_mf;
      k.template bottomLeftCorner<3, 3>() = k_fm;
      k.template bottomRightCorner<3, 3>() = k_ff;
      d.template topLeftCorner<3, 3>() = d_mm;
      d.template topRightCorner<3, 3>() = d_mf;
      d.template bottomLeftCorner<3, 3>() = d_fm;
      d.template bottomRightCorner<3, 3>() = d_ff;
      k *= h;
      d *= h;
      wrench *= h;
      V6<T> by_v, by_q, by_q_turned;
      for (int i = 0; i < c.n; ++i) {  // column: displacement of dof j
        const int j = contact.pair.dof[i];
        const bool j_first = contact.pair.first[i];
        by_v.noalias() = d * c.s[i];
        by_q.noalias() = k * c.s[i];
        by_q.noalias() += d * c.y[i];
        // −(S_j ×* W) where j moves the first body, +(S_j ×* W) where it moves the second: s_j S_j carries the sign.
        by_q_turned = by_q - cross_force<T>(c.s[i], wrench);
        for (int r = 0; r < c.n; ++r) {
          const int row = contact.pair.dof[r];
          const bool row_first = contact.pair.first[r];
          const bool turned = j_first ? row_first && m.carries(j, row) : row_first || !m.carries(j, row);
          w.by_q(row, j) -= dot6<T>(c.s[r], turned ? by_q_turned : by_q);
          w.by_v(row, j) -= dot6<T>(c.s[r], by_v);
        }
      }
    }
  }
}

// Wrench of every contact on its first body, about the world's origin: (moment, force), shape (contacts, 6). Needs the
// kinematics of (q, v) in w.
template <class T>
void contact_wrenches(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                      const Workspace<T>& w, T* out) {
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    V6<T> wrench = V6<T>::Zero();
    sum_forces<false, T>(frame, set.cloud, touch_rule<T>(m, contact, params, anchors, anchored), wrench, {});
    const V3<T> moment = frame.to_world * top(wrench), push = frame.to_world * bottom(wrench);
    const V6<T> in_world = stack<T>(moment + cross<T>(frame.origin, push), push);
    for (int i = 0; i < 6; ++i) out[6 * n + i] = in_world[i];
  }
}

// Anchors after an accepted step (w holds its kinematics). `next` and `next_set` may be the arrays that are read.
template <class T>
void advance_contact_anchors(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                             Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  for (const Contact& contact : m.contacts) {
    if (contact.anchor < 0) continue;
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    advance_anchors<T>(frame, set.cloud, touch_rule<T>(m, contact, params, anchors, anchored), w.kept,
                       next + contact.anchor, next_set + contact.anchor);
  }
}

// The reverse pass of the anchors. First call (`from_next`): gradients of the anchors after the step go to the state at
// the step's end (by_q, by_v) and to the anchors before (by_anchor). Second call, with c the multipliers of the residual:
// what the residual says of the anchors before.
template <bool from_next, class T>
void contact_anchors_transposed(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                                const std::uint8_t* anchored, const Workspace<T>& w, const V3<T>* by_next,
                                const VX<T>& multipliers, VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  using L = Pack<T>;
  PairColumns<T> c;
  for (const Contact& contact : m.contacts) {
    if (contact.anchor < 0) continue;
    const Mount& first = m.point_sets[contact.points].mount;
    const PairFrame<T> frame = pair_frame<T>(params, first, m.shapes[contact.shape], w);
    pair_columns<true, T>(contact.pair, first.body, frame, w, c);
    V6<T> by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
    const TouchRule<T> rule = touch_rule<T>(m, contact, params, anchors, anchored);
    V3<T>* const by_own = by_anchor + contact.anchor;
    if constexpr (from_next) {
      anchors_transposed<T>(frame, m.point_sets[contact.points].cloud, rule, by_next + contact.anchor, by_pose,
                            by_twist, by_own);
      pull_back<T>(contact.pair, c, by_pose, by_twist, by_q, by_v);
    } else {
      V6<T> virtual_twist = V6<T>::Zero();
      for (int i = 0; i < c.n; ++i) virtual_twist += c.s[i] * multipliers[contact.pair.dof[i]];
      for_touching_points<T>(frame, m.point_sets[contact.points].cloud, rule, [&](const Touching<T>& t) {
        PointForce<L> force;
        point_force<2>(t.law, t.at, t.v, t.e, t.remembers, force);
        const Vec3<L> weight =
            L(h) * (spread<L>(V3<T>(bottom(virtual_twist))) + cross(spread<L>(V3<T>(top(virtual_twist))), t.x));
        const Vec3<L> by = transposed_times(force.by_anchor, weight);
        t.for_each_inside([&](int k, int i) { by_own[i] += lane3<T>(by, k); });
      });
    }
  }
}

}  // namespace gelflow
