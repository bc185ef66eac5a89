// Loop closures: two points of two bodies that coincide (connect), with the same orientation of the bodies (weld). They
// are kept by stiff damped springs, whose compliance is a parameter. Forces and derivatives go the way of a contact with
// one point, in the frame of the second body at its point:
//
//     f = −k p − d (V_lin + ω × p),    τ = −k_t φ − d_t ω,    φ = ½ (R − Rᵀ)^∨
//
// with p the first point, R the turn of the first body from the orientation of the weld, and (ω, V) the relative twist.
#pragma once

#include "contact/contact_forces.hpp"

namespace gelflow {

// Motion of the first body relative to the frame of the second one at its point. `frame` has to_world, origin and the
// relative twist.
template <class T>
struct ClosureMotion {
  PairFrame<T> frame;
  V3<T> gap;     // p
  M3<T> turned;  // R
};

template <class T>
ClosureMotion<T> closure_motion(const LoopClosure& c, const LoopClosureParams<T>& p, const Workspace<T>& w) {
  using Scalar = PositionScalar<T>;
  const auto rotation_of_body = [&](int b) { return b == world ? M3<Scalar>(M3<Scalar>::Identity()) : w.rotation[b]; };
  const auto point_of_body = [&](int b, const V3<T>& point) {
    const V3<Scalar> local = as<Scalar>(point);
    return b == world ? local : V3<Scalar>(w.position[b] + w.rotation[b] * local);
  };
  const M3<Scalar> to_world = rotation_of_body(c.second);
  const V3<Scalar> origin = point_of_body(c.second, p.second);
  const V3<Scalar> gap = to_world.transpose() * V3<Scalar>(point_of_body(c.first, p.first) - origin);
  const M3<Scalar> relative = to_world.transpose() * rotation_of_body(c.first);
  ClosureMotion<T> motion;
  motion.frame.to_world = as<T>(to_world);
  motion.frame.origin = as<T>(origin);
  motion.gap = as<T>(gap);
  motion.turned = as<T>(relative) * c.rotation.transpose().template cast<T>();
  V6<T> twist = c.first == world ? V6<T>(V6<T>::Zero()) : w.twist[c.first];
  if (c.second != world) twist -= w.twist[c.second];
  const V6<T> local = motion.frame.motion(twist);
  motion.frame.angular = top(local);
  motion.frame.linear = bottom(local);
  return motion;
}

// Adds a 3 × 3 block to K or D of the sums; `rows`, `columns`: 0 moments and rotations, 3 forces and translations.
template <class T>
void add_block(T* matrix, int rows, int columns, const M3<T>& block) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) matrix[6 * (rows + i) + columns + j] += block(i, j);
  }
}

// Wrench on the first body, and with derivatives K and D, about the frame's origin.
template <bool derivatives, class T>
void closure_sums(const LoopClosure& c, const LoopClosureParams<T>& p, const ClosureMotion<T>& motion,
                  ContactSums<T>& sums) {
  const V3<T>& gap = motion.gap;
  const V3<T>& spin = motion.frame.angular;
  const V3<T> force = -p.stiffness * gap - p.damping * (motion.frame.linear + cross<T>(spin, gap));
  V3<T> moment = cross<T>(gap, force);
  const M3<T> difference = motion.turned - motion.turned.transpose();
  const V3<T> turn = V3<T>(difference(2, 1), difference(0, 2), difference(1, 0)) * T(0.5);
  if (c.weld) moment -= p.turn_stiffness * turn + p.turn_damping * spin;
  for (int i = 0; i < 3; ++i) {
    sums.values[i] = moment[i];
    sums.values[3 + i] = force[i];
  }
  if constexpr (derivatives) {
    std::fill(sums.values + ContactSums<T>::k_at, sums.values + ContactSums<T>::padded, T(0));
    const M3<T> arm = skew<T>(gap), one = M3<T>::Identity();
    const M3<T> by_velocity = -p.damping * one;
    const M3<T> by_position = -p.stiffness * one - p.damping * skew<T>(spin);
    T *const k = sums.values + ContactSums<T>::k_at, *const d = sums.values + ContactSums<T>::d_at;
    add_block<T>(d, 3, 3, by_velocity);
    add_block<T>(d, 3, 0, -by_velocity * arm);
    add_block<T>(d, 0, 3, arm * by_velocity);
    add_block<T>(d, 0, 0, -arm * by_velocity * arm);
    const M3<T> moment_by_position = arm * by_position - skew<T>(force);
    add_block<T>(k, 3, 3, by_position);
    add_block<T>(k, 3, 0, -by_position * arm);
    add_block<T>(k, 0, 3, moment_by_position);
    add_block<T>(k, 0, 0, -moment_by_position * arm);
    if (!c.weld) return;
    // A small turn δ of the first body changes R by [δ]× R, and φ by ½ (tr R − R) δ.
    add_block<T>(k, 0, 0, -p.turn_stiffness * T(0.5) * (motion.turned.trace() * one - motion.turned));
    add_block<T>(d, 0, 0, -p.turn_damping * one);
  }
}

// Subtracts β h · (generalized forces of the closures) from w.residual; with derivatives also from w.dg_dq and w.dg_dv.
template <bool derivatives, class T>
void subtract_loop_closures(const Model& m, const T* params, const T& beta_h, bool add_impulses, Workspace<T>& w) {
  ContactSums<T> sums;
  for (const LoopClosure& c : m.loop_closures) {
    const LoopClosureParams<T>& p = c.params.in(params);
    const ClosureMotion<T> motion = closure_motion<T>(c, p, w);
    closure_sums<derivatives, T>(c, p, motion, sums);
    subtract_impulses<T>(c.pair, beta_h, wrench_in_world<T>(motion.frame, sums.wrench()), add_impulses, w);
    if constexpr (derivatives) {
      contact_jacobian<T>(c.pair, c.first, motion.frame, w);
      subtract_contact_derivatives<T>(beta_h, sums, w);
    }
  }
}

}  // namespace gelflow
