// Contact forces on the joints, and the anchors' turn at the end of a step.
//
// Per pair one wrench W on the first body (−W on the second) and two 6 × 6 blocks, K = ∂W/∂ξ and D = ∂W/∂V, are summed
// in the shape's frame and carried to the joints once. A point's displacement is ξ_lin + ξ_ang × c with c the point
// itself, or the sphere's centre for a rolling point.
#pragma once

#include "pair.hpp"

namespace gelflow {

// Calls f(i, x, c, law, distance, v, e, anchored) for every point of the contact that is inside the shape.
template <class T, class F, class Skip>
void for_touching_points(const Model& m, const Contact& contact, const T* params, const T& h, const PairFrame<T>& frame,
                         const V3<T>* anchors, const std::uint8_t* anchored, F&& f, Skip&& outside) {
  const PointSet& set = m.point_sets[contact.points];
  PointLaw<T> numbers = law_numbers<T>(params + contact.param, contact.law, contact.damping, h);
  numbers.rolling = set.radius > 0;
  Distance<T> at;
  for_near_points<T>(
      frame, set.cloud, set.radius,
      [&](int i) {
        const V3<T> c = frame.point(set.cloud.points[i]);
        V3<T> x = c;
        if (numbers.rolling) x[2] -= T(set.radius);  // planes only: n = z
        distance<T>(frame.kind, frame.size, x, at);
        if (!(at.d < T(0))) {
          outside(i, i + 1);
          return;
        }
        const PointLaw<T> law = weighted<T>(numbers, set.cloud.weights[i]);
        const V3<T> v = frame.velocity(x);
        const bool remembers = numbers.elastic && anchored[contact.anchor + i];
        const V3<T> anchor = remembers ? anchors[contact.anchor + i] : V3<T>(V3<T>::Zero());
        f(i, x, c, law, at, v, anchor_offset<T>(law, x, v, anchor, remembers), anchor, remembers);
      },
      outside);
}

inline void ignore(int, int) {}

// Subtracts h · (contact forces) from w.residual; with derivatives also from w.by_q and w.by_v. `scale`: adds the
// forces' size to w.scale.
template <bool derivatives, class T>
void subtract_contact_forces(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                             const std::uint8_t* anchored, bool scale, Workspace<T>& w) {
  using std::abs;
  PairColumns<T> c;
  for (const Contact& contact : m.contacts) {
    const Shape& shape = m.shapes[contact.shape];
    const int first = m.point_sets[contact.points].body;
    const PairFrame<T> frame = pair_frame<T>(params, first, shape, w);
    V6<T> wrench = V6<T>::Zero();
    // The blocks of K and D: rows moment, force; columns turn, shift.
    M3<T> k_mm = M3<T>::Zero(), k_mf = k_mm, k_fm = k_mm, k_ff = k_mm;
    M3<T> d_mm = k_mm, d_mf = k_mm, d_fm = k_mm, d_ff = k_mm;
    PointForce<T> force;
    bool touching = false;
    for_touching_points<T>(
        m, contact, params, h, frame, anchors, anchored,
        [&](int, const V3<T>& x, const V3<T>& center, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v,
            const V3<T>& e, const V3<T>&, bool remembers) {
          touching = true;
          point_force<derivatives ? 1 : 0, T>(law, at, v, e, remembers, force);
          wrench += stack<T>(cross<T>(x, force.force), force.force);
          if constexpr (derivatives) {
            const M3<T> a = force.by_x + cross_rows<T>(force.by_v, frame.angular);
            const M3<T> moment = cross_columns<T>(x, a) - skew<T>(force.force);
            const M3<T> moment_v = cross_columns<T>(x, force.by_v);
            k_mm -= cross_rows<T>(moment, center);
            k_mf += moment;
            k_fm -= cross_rows<T>(a, center);
            k_ff += a;
            d_mm -= cross_rows<T>(moment_v, x);
            d_mf += moment_v;
            d_fm -= cross_rows<T>(force.by_v, x);
            d_ff += force.by_v;
          }
        },
        ignore);
    if (!touching) continue;
    pair_columns<derivatives, T>(contact.pair, first, frame, w, c);
    for (int i = 0; i < c.n; ++i) {
      const T force_i = c.s[i].dot(wrench);
      w.residual[contact.pair.dof[i]] -= h * force_i;
      if (scale) w.scale[contact.pair.dof[i]] += h * abs(force_i);
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
void contact_wrenches(const Model& m, const T* params, const T& h, const V3<T>* anchors, const std::uint8_t* anchored,
                      const Workspace<T>& w, T* out) {
  PointForce<T> force;
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    const PairFrame<T> frame = pair_frame<T>(params, m.point_sets[contact.points].body, m.shapes[contact.shape], w);
    V6<T> wrench = V6<T>::Zero();
    for_touching_points<T>(
        m, contact, params, h, frame, anchors, anchored,
        [&](int, const V3<T>& x, const V3<T>&, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v,
            const V3<T>& e, const V3<T>&, bool remembers) {
          point_force<0, T>(law, at, v, e, remembers, force);
          wrench += stack<T>(cross<T>(x, force.force), force.force);
        },
        ignore);
    const V3<T> moment = frame.to_world * top(wrench), push = frame.to_world * bottom(wrench);
    const V6<T> in_world = stack<T>(moment + cross<T>(frame.origin, push), push);
    for (int i = 0; i < 6; ++i) out[6 * n + i] = in_world[i];
  }
}

// Anchors after an accepted step (w holds its kinematics). `next` and `next_set` may be the arrays that are read.
template <class T>
void advance_contact_anchors(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                             const std::uint8_t* anchored, const Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  PointForce<T> force;
  for (const Contact& contact : m.contacts) {
    if (contact.anchor < 0) continue;
    const PairFrame<T> frame = pair_frame<T>(params, m.point_sets[contact.points].body, m.shapes[contact.shape], w);
    for_touching_points<T>(
        m, contact, params, h, frame, anchors, anchored,
        [&](int i, const V3<T>& x, const V3<T>&, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v,
            const V3<T>& e, const V3<T>& anchor, bool remembers) {
          point_force<0, T>(law, at, v, e, remembers, force);
          next[contact.anchor + i] = next_anchor<T>(law, force, at.n, x, e, anchor, remembers);
          next_set[contact.anchor + i] = 1;
        },
        [&](int begin, int end) { std::fill(next_set + contact.anchor + begin, next_set + contact.anchor + end, 0); });
  }
}

// The reverse pass of the anchors. First call (`from_next`): gradients of the anchors after the step go to the state at
// the step's end (by_q, by_v) and to the anchors before (by_anchor). Second call, with c the multipliers of the residual:
// what the residual says of the anchors before.
template <bool from_next, class T>
void contact_anchors_transposed(const Model& m, const T* params, const T& h, const V3<T>* anchors,
                                const std::uint8_t* anchored, const Workspace<T>& w, const V3<T>* by_next,
                                const VX<T>& multipliers, VX<T>& by_q, VX<T>& by_v, V3<T>* by_anchor) {
  PointForce<T> force;
  PairColumns<T> c;
  for (const Contact& contact : m.contacts) {
    if (contact.anchor < 0) continue;
    const int first = m.point_sets[contact.points].body;
    const PairFrame<T> frame = pair_frame<T>(params, first, m.shapes[contact.shape], w);
    pair_columns<true, T>(contact.pair, first, frame, w, c);
    V6<T> virtual_twist = V6<T>::Zero(), by_pose = V6<T>::Zero(), by_twist = V6<T>::Zero();
    if constexpr (!from_next) {
      for (int i = 0; i < c.n; ++i) virtual_twist += c.s[i] * multipliers[contact.pair.dof[i]];
    }
    for_touching_points<T>(
        m, contact, params, h, frame, anchors, anchored,
        [&](int i, const V3<T>& x, const V3<T>& center, const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v,
            const V3<T>& e, const V3<T>&, bool remembers) {
          point_force<2, T>(law, at, v, e, remembers, force);
          if constexpr (from_next) {
            const AnchorGradient<T> g = next_anchor_transposed<T>(law, force, remembers, by_next[contact.anchor + i]);
            const V3<T> by_point = g.x - cross<T>(frame.angular, g.v);
            by_pose += stack<T>(cross<T>(center, by_point), by_point);
            by_twist += stack<T>(cross<T>(x, g.v), g.v);
            if (remembers) by_anchor[contact.anchor + i] += g.anchor;
          } else if (remembers) {
            const V3<T> weight = h * (bottom(virtual_twist) + cross<T>(top(virtual_twist), x));
            by_anchor[contact.anchor + i] += force.by_anchor.transpose() * weight;
          }
        },
        ignore);
    if constexpr (from_next) pull_back<T>(contact.pair, c, by_pose, by_twist, by_q, by_v);
  }
}

}  // namespace gelflow
