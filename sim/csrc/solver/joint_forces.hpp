// Generalized forces in joint space: damping, dry friction, springs, limits and actuators of joints and tendons.
#pragma once

#include "solver/tendon_forces.hpp"

namespace gelflow {

// Dry friction in a joint is viscous below this speed [m/s or rad/s].
constexpr double friction_creep = 1e-3;

// A joint limit is a damped spring that never pulls. Its damping begins over this depth [m or rad], so that the force is
// continuous: without the ramp the step in which a light, fast joint arrives has no solution.
constexpr double limit_ramp = 1e-5;

template <class T>
struct LimitForce {
  T force, dforce_dq, dforce_dv;
};
template <class T>
LimitForce<T> limit_force(const JointParams<T>& p, const T& value, const T& v) {
  const bool above = value > p.upper, below = value < p.lower;
  if (!above && !below) return {T(0), T(0), T(0)};
  const T beyond = value - (above ? p.upper : p.lower);
  T damping = p.limit_damping, stiffness = p.limit_stiffness;
  if (const T share = (above ? beyond : T(-beyond)) / T(limit_ramp); share < T(1)) {
    stiffness += (above ? v : T(-v)) * damping / T(limit_ramp);
    damping *= share;
  }
  const T force = p.limit_stiffness * beyond + damping * v;
  if (above ? force > T(0) : force < T(0)) return {force, stiffness, damping};
  return {T(0), T(0), T(0)};
}

// Dry friction and its derivative by speed.
template <class T>
struct DryFriction {
  T force, dforce_dspeed;
};
template <class T>
DryFriction<T> dry_friction(const T& frictionloss, const T& speed, const T& creep) {
  using std::abs;
  if (abs(speed) > creep) return {speed > T(0) ? frictionloss : T(-frictionloss), T(0)};
  return {T(frictionloss / creep * speed), T(frictionloss / creep)};
}

template <class T, class Q>
GELFLOW_INLINE Transmission<T> transmission(const Model& m, const Actuator& actuator, const Q* q, const T* v) {
  if (actuator.tendon >= 0) return tendon_motion<T>(m.tendons[actuator.tendon], q, v);
  return {T(q[actuator.q]), v[actuator.dof]};
}

// Force of an actuator and its derivatives by control, length and speed (gear times those of the joint or tendon).
template <class T>
struct ActuatorForce {
  T force, dforce_du, dforce_dlength, dforce_dspeed;
  int clipped;  // bits: 1 control below, 2 above its range; 4 force below, 8 above
};
template <class T>
ActuatorForce<T> actuator_force(const Actuator& actuator, const ActuatorParams<T>& p, const T& u,
                                const Transmission<T>& at, double continuation = 1) {
  const T gear = p.gear, kp = p.kp, kd = p.kd;
  ActuatorForce<T> out{T(0), T(1), T(0), T(0), 0};
  T bias = T(0);
  switch (actuator.kind) {
    case ActuatorKind::motor:
      break;
    case ActuatorKind::position:
      out = {T(0), kp, -kp, -kd, 0};
      break;
    case ActuatorKind::velocity:
      out = {T(0), kd, T(0), -kd, 0};
      break;
    case ActuatorKind::general:
      out = {T(0), p.gain, -kp, -kd, 0};
      bias = p.bias;
      break;
  }
  const T gain = out.dforce_du;
  T control = u;
  if (u < p.ctrl_lower || u > p.ctrl_upper) {
    out.clipped = u < p.ctrl_lower ? 1 : 2;
    control = u < p.ctrl_lower ? p.ctrl_lower : p.ctrl_upper;
    out.dforce_du = T(0);
  }
  out.force = gain * control + bias + out.dforce_dlength * (gear * at.position) + out.dforce_dspeed * (gear * at.speed);
  if (continuation < 1) {
    out.force *= T(continuation);
    out.dforce_dlength *= T(continuation);
    out.dforce_dspeed *= T(continuation);
  }
  if (out.force < p.force_lower || out.force > p.force_upper) {
    const bool below = out.force < p.force_lower;
    return {below ? p.force_lower : p.force_upper, T(0), T(0), T(0), out.clipped | (below ? 4 : 8)};
  }
  return out;
}

// Damping, dry friction and armature of all dofs of a joint.
template <bool derivatives, class T>
GELFLOW_INLINE void add_dof_forces(const Joint& joint, const JointParams<T>& p, const T& beta_h, const T* v,
                                   const T& creep, bool add_impulses, Workspace<T>& w) {
  const T damping = p.damping, armature = p.armature;
  for (int k = joint.v; k < joint.v + joint.dofs; ++k) {
    w.residual[k] += beta_h * damping * v[k];
    if constexpr (derivatives) w.dg_dv.in_tree(k, k) += beta_h * damping;
    if (p.frictionloss != T(0)) {
      const DryFriction<T> friction = dry_friction<T>(p.frictionloss, v[k], creep);
      w.residual[k] += beta_h * friction.force;
      if (add_impulses) w.impulses[k] += beta_h * p.frictionloss;
      if constexpr (derivatives) w.dg_dv.in_tree(k, k) += beta_h * friction.dforce_dspeed;
    }
    if (armature != T(0)) {
      w.residual[k] += armature * w.velocity_change[k];
      if constexpr (derivatives) {
        w.dg_dv.in_tree(k, k) += armature;
        w.mass.in_tree(k, k) += armature;
      }
    }
  }
}

// Spring and limit of a slide or hinge.
template <bool derivatives, class T>
GELFLOW_INLINE void add_spring_and_limit(const Joint& joint, const JointParams<T>& p, const T& beta_h,
                                         const PositionScalar<T>* q, const T* v, Workspace<T>& w) {
  const T stiffness = p.stiffness, springref = p.springref;
  const int k = joint.v;
  const T value(q[joint.q]);
  w.residual[k] += beta_h * stiffness * (value - springref);
  if constexpr (derivatives) w.dg_dq.in_tree(k, k) += beta_h * stiffness;
  const LimitForce<T> limit = limit_force<T>(p, value, v[k]);
  w.residual[k] += beta_h * limit.force;
  if constexpr (derivatives) {
    w.dg_dq.in_tree(k, k) += beta_h * limit.dforce_dq;
    w.dg_dv.in_tree(k, k) += beta_h * limit.dforce_dv;
  }
}

// Spring, limit, damping, dry friction and armature of a tendon.
template <bool derivatives, class T>
void add_tendon_forces(const Tendon& tendon, const JointParams<T>& p, const T& beta_h, const PositionScalar<T>* q,
                       const T* v, const T& creep, bool add_impulses, Workspace<T>& w) {
  const Transmission<T> at = tendon_motion<T>(tendon, q, v);
  const LimitForce<T> limit = limit_force<T>(p, at.position, at.speed);
  const DryFriction<T> friction = dry_friction<T>(p.frictionloss, at.speed, creep);
  const T force = p.stiffness * (at.position - p.springref) + p.damping * at.speed + limit.force + friction.force;
  const T dforce_dlength = p.stiffness + limit.dforce_dq;
  const T dforce_dspeed = p.damping + limit.dforce_dv + friction.dforce_dspeed;
  add_tendon_impulse<derivatives, T>(tendon, beta_h * force, beta_h * dforce_dlength, beta_h * dforce_dspeed,
                                     add_impulses, w);
  // Its derivative is the mass matrix (add_tendon_mass).
  if (p.armature != T(0)) {
    add_tendon_impulse<false, T>(tendon, armature_impulse<T>(tendon, p.armature, w), T(0), T(0), false, w);
  }
}

// Adds the impulse of an actuator on its joint or tendon.
template <bool derivatives, class T>
GELFLOW_INLINE void subtract_actuator_impulse(const Model& m, const Actuator& actuator, const T& beta_h, const T& gear,
                                              const ActuatorForce<T>& out, bool add_impulses, Workspace<T>& w) {
  using std::abs;
  if (actuator.tendon >= 0) {
    const T squared = beta_h * gear * gear;
    add_tendon_impulse<derivatives, T>(m.tendons[actuator.tendon], -beta_h * gear * out.force,
                                       -squared * out.dforce_dlength, -squared * out.dforce_dspeed, add_impulses, w);
    return;
  }
  const int k = actuator.dof;
  w.residual[k] -= beta_h * gear * out.force;
  if (add_impulses) w.impulses[k] += beta_h * abs(gear * out.force);
  if constexpr (derivatives) {
    w.dg_dq.in_tree(k, k) -= beta_h * gear * gear * out.dforce_dlength;
    w.dg_dv.in_tree(k, k) -= beta_h * gear * gear * out.dforce_dspeed;
  }
}

// Sum of a vector over what an actuator drives: cᵀ ∂(residual)/∂(force along it) for multipliers c.
template <class T>
T along_transmission(const Model& m, const Actuator& actuator, const VX<T>& values) {
  if (actuator.tendon < 0) return values[actuator.dof];
  T sum(0);
  for (const Tendon::Term& term : m.tendons[actuator.tendon].terms) sum += T(term.coefficient) * values[term.dof];
  return sum;
}

// Adds −β h f and its derivatives to the residual, f the forces of joints, tendons and actuators.
template <bool derivatives, class T>
void subtract_joint_forces(const Model& m, const T* params, const T& beta_h, const PositionScalar<T>* q, const T* v,
                           const T* u, double continuation, bool add_impulses, Workspace<T>& w) {
  const T creep(friction_creep / continuation);
  for (const Joint& joint : m.joints) {
    const JointParams<T>& p = joint.params.in(params);
    add_dof_forces<derivatives, T>(joint, p, beta_h, v, creep, add_impulses, w);
    if (!joint.has_quaternion()) add_spring_and_limit<derivatives, T>(joint, p, beta_h, q, v, w);
  }
  for (const Tendon& tendon : m.tendons) {
    add_tendon_forces<derivatives, T>(tendon, tendon.params.in(params), beta_h, q, v, creep, add_impulses, w);
  }
  for (std::size_t a = 0; a < m.actuators.size(); ++a) {
    const Actuator& actuator = m.actuators[a];
    const ActuatorParams<T>& p = actuator.params.in(params);
    const T gear = p.gear;
    const ActuatorForce<T> out = actuator_force<T>(actuator, p, u[a], transmission<T>(m, actuator, q, v), continuation);
    subtract_actuator_impulse<derivatives, T>(m, actuator, beta_h, gear, out, add_impulses, w);
    if constexpr (derivatives) w.dg_du[a] = -beta_h * gear * out.dforce_du;
  }
}

}  // namespace gelflow
