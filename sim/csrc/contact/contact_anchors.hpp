// Update of the anchors of all contacts of the model at the end of a step (cloud_anchors.hpp: of one point cloud), and
// its vector-Jacobian products.
#pragma once

#include "contact/arc_correction.hpp"
#include "contact/cloud_anchors.hpp"
#include "contact/contact_jacobian.hpp"

namespace gelflow {

// Anchors of all contacts after an accepted step, whose forces were the last ones evaluated in w. `next` and `next_set`:
// the arrays that are read, or copies of them.
template <class T>
void advance_contact_anchors(const Model& m, const T* params, const T& step_length, const V3<T>* anchors,
                             const std::uint8_t* anchored, Workspace<T>& w, V3<T>* next, std::uint8_t* next_set) {
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    if (contact.anchor < 0) continue;
    const PointSet& set = m.point_sets[contact.points];
    if (!advance_anchored<T>(w.candidates[n], set.cloud.size(), next_set + contact.anchor)) continue;
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    const ContactSettings<T> settings = contact_settings<T>(m, contact, params, anchors, anchored, step_length);
    advance_moved_anchors<T>(frame, w.candidates[n], settings, next + contact.anchor);
  }
}

// Gradients with respect to the anchors after the step (`grad_next`), carried to the state at the step's end (grad_q,
// grad_v) and to the anchors before it (grad_anchor).
template <class T>
void contact_anchors_vjp(const Model& m, const T* params, const T& step_length, const V3<T>* anchors,
                         const std::uint8_t* anchored, Workspace<T>& w, const V3<T>* grad_next, VX<T>& grad_q,
                         VX<T>& grad_v, V3<T>* grad_anchor) {
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    if (contact.anchor < 0) continue;
    const Mount& first = m.point_sets[contact.points].mount;
    const PairFrame<T> frame = pair_frame<T>(params, first, m.shapes[contact.shape], w);
    contact_jacobian<T>(contact.pair, first.body, frame, w);
    V6<T> grad_pose = V6<T>::Zero(), grad_twist = V6<T>::Zero();
    anchors_vjp<T>(frame, w.candidates[n], contact_settings<T>(m, contact, params, anchors, anchored, step_length),
                   grad_next + contact.anchor, grad_pose, grad_twist, grad_anchor + contact.anchor);
    contact_jacobian_vjp<T>(w.jacobian, grad_pose, grad_twist, grad_q, grad_v);
  }
}

// Σ S_j c_j, the relative twist of the pair in the shape's frame that the multipliers c stand for.
template <class T>
V6<T> virtual_twist(const ContactJacobian<T>& c, const VX<T>& multipliers) {
  V6<T> twist = V6<T>::Zero();
  for (int i = 0; i < c.n; ++i) {
    if (c.dofs->dof[i] >= 0) twist += c.s[i] * multipliers[c.dofs->dof[i]];
  }
  return twist;
}

// Adds −cᵀ ∂g/∂(anchors before the step) with c the multipliers of the residual g. `bdf2`: the step was one of BDF2.
template <class T>
void residual_anchors_vjp(const Model& m, const T* params, const T& beta_h, bool bdf2, const V3<T>* anchors,
                          const std::uint8_t* anchored, Workspace<T>& w, const VX<T>& multipliers, V3<T>* grad_anchor) {
  using P = Pack<T>;
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    if (contact.anchor < 0) continue;
    const Mount& first = m.point_sets[contact.points].mount;
    const PairFrame<T> frame = pair_frame<T>(params, first, m.shapes[contact.shape], w);
    contact_jacobian<T>(contact.pair, first.body, frame, w);
    const ContactSettings<T> settings = contact_settings<T>(m, contact, params, anchors, anchored);
    V3<T>* const grad_contact = grad_anchor + contact.anchor;
    const V6<T> twist = virtual_twist<T>(w.jacobian, multipliers);
    const bool arc = contact.uses_arc_correction && !bdf2;
    const Mat3<P> arm =
        broadcast<P>(arc ? MomentArmCorrection<T>(beta_h * frame.angular, false).value : M3<T>(M3<T>::Zero()));
    const Vec3<P> origin = broadcast<P>(arc ? body_origin_in_shape<T>(frame, first.body, w) : V3<T>(V3<T>::Zero()));
    const Vec3<P> angular = broadcast<P>(V3<T>(top(twist))), linear = broadcast<P>(V3<T>(bottom(twist)));
    for_contact_points<true, T>(frame, w.candidates[n], settings, [&](const ContactPack<T>& t) {
      const Vec3<P> grad_friction = P(beta_h) * (linear + cross(angular, t.x)), none = zero3<P>();
      const Vec3<P> grad_spring = P(beta_h) * cross(angular, arm * (t.center - origin));
      const P q = relaxation_factor(t.law, P(beta_h));  // −k_s s = k_t v_t + q f_t + (1 − q) f*
      const Vec3<P> grad = point_force_vjp(t.law, t.at, t.v, t.e, t.has_anchor, none, grad_friction + q * grad_spring,
                                           (P(1.0) - q) * grad_spring, none)
                               .anchor;
      t.for_each_active([&](int k, int i) { grad_contact[i] += lane3<T>(grad, k); });
    });
  }
}

}  // namespace gelflow
