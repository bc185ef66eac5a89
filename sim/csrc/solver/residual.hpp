// The residual g of one implicit step (step.hpp) and its derivatives, written as
//
//     g(v_t) = β h · (inverse dynamics of (q_t, v_t, (v_t − v*)/(β h)) − f),    q_t = q_{t-1} ⊕ (β h v_t + γ δ)
//
// In the code h is β h.
#pragma once

#include "contact/contact.hpp"
#include "dynamics/inverse_dynamics.hpp"

namespace gelflow {

// Below this speed dry friction in a joint is viscous [m/s or rad/s].
constexpr double friction_creep = 1e-3;

// A limit pushes back like a damped spring and never pulls; p: the joint's parameters.
template <class T>
struct LimitPush {
  T force, by_q, by_v;
};
template <class T>
LimitPush<T> limit_push(const T* p, const T& value, const T& v) {
  const bool above = value > p[5], below = value < p[4];
  if (!above && !below) return {T(0), T(0), T(0)};
  const T force = p[6] * (value - (above ? p[5] : p[4])) + p[7] * v;
  if (above ? force > T(0) : force < T(0)) return {force, p[6], p[7]};
  return {T(0), T(0), T(0)};
}

// What an actuator pulls with, and its derivatives by the control, its length and its speed (gear × those of the joint).
template <class T>
struct ActuatorPull {
  T force, by_u, by_length, by_speed;
  int clipped;  // bits: 1 control below, 2 above its range; 4 force below, 8 above
};
template <class T, class Q>
ActuatorPull<T> actuator_pull(const Actuator& actuator, const T* p, const T& u, const Q* q, const T* v,
                              double continuation = 1) {
  const T gear = p[0], kp = p[1], kd = p[2];
  ActuatorPull<T> pull{T(0), T(1), T(0), T(0), 0};
  T bias = T(0);
  switch (actuator.kind) {
    case ActuatorKind::motor:
      break;
    case ActuatorKind::position:
      pull = {T(0), kp, -kp, -kd, 0};
      break;
    case ActuatorKind::velocity:
      pull = {T(0), kd, T(0), -kd, 0};
      break;
    case ActuatorKind::general:
      pull = {T(0), p[7], -kp, -kd, 0};
      bias = p[8];
      break;
  }
  const T gain = pull.by_u;
  T control = u;
  if (u < p[5] || u > p[6]) {
    pull.clipped = u < p[5] ? 1 : 2;
    control = u < p[5] ? p[5] : p[6];
    pull.by_u = T(0);
  }
  pull.force =
      gain * control + bias + pull.by_length * (gear * T(q[actuator.q])) + pull.by_speed * (gear * v[actuator.dof]);
  if (continuation < 1) {
    pull.force *= T(continuation);
    pull.by_length *= T(continuation);
    pull.by_speed *= T(continuation);
  }
  if (pull.force < p[3] || pull.force > p[4]) {
    const bool below = pull.force < p[3];
    return {below ? p[3] : p[4], T(0), T(0), T(0), pull.clipped | (below ? 4 : 8)};
  }
  return pull;
}

// Joint-space forces: damping, friction, springs, limits, actuators. Adds −h f and its derivatives to the residual.
template <bool derivatives, class T>
void subtract_joint_forces(const Model& m, const T* params, const T& h, const PositionScalar<T>* q, const T* v,
                           const T* u, double continuation, bool add_impulses, Workspace<T>& w) {
  using std::abs;
  const T creep(friction_creep / continuation);
  for (const Joint& joint : m.joints) {
    const T* p = params + joint.param;
    const T damping = p[0], armature = p[1], stiffness = p[2], rest = p[3];
    for (int k = joint.v; k < joint.v + joint.dofs; ++k) {
      w.residual[k] += h * damping * v[k];
      if constexpr (derivatives) w.by_v(k, k) += h * damping;
      if (p[8] != T(0)) {  // dry friction: viscous below this speed, constant above
        const bool slides = abs(v[k]) > creep;
        const T force = slides ? T(v[k] > T(0) ? p[8] : -p[8]) : T(p[8] / creep * v[k]);
        w.residual[k] += h * force;
        if (add_impulses) w.impulses[k] += h * p[8];
        if constexpr (derivatives) w.by_v(k, k) += slides ? T(0) : T(h * p[8] / creep);
      }
      if (armature != T(0)) {
        w.residual[k] += armature * w.trial[k];  // w.trial holds v_t − v*
        if constexpr (derivatives) {
          w.by_v(k, k) += armature;
          w.mass(k, k) += armature;
        }
      }
    }
    if (joint.has_quaternion()) continue;
    const int k = joint.v;
    const T value(q[joint.q]);
    w.residual[k] += h * stiffness * (value - rest);
    if constexpr (derivatives) w.by_q(k, k) += h * stiffness;
    const LimitPush<T> push = limit_push<T>(p, value, v[k]);
    w.residual[k] += h * push.force;
    if constexpr (derivatives) {
      w.by_q(k, k) += h * push.by_q;
      w.by_v(k, k) += h * push.by_v;
    }
  }
  for (std::size_t a = 0; a < m.actuators.size(); ++a) {
    const Actuator& actuator = m.actuators[a];
    const T* p = params + actuator.param;
    const T gear = p[0];
    const int k = actuator.dof;
    const ActuatorPull<T> pull = actuator_pull<T>(actuator, p, u[a], q, v, continuation);
    w.residual[k] -= h * gear * pull.force;
    if (add_impulses) w.impulses[k] += h * abs(gear * pull.force);
    if constexpr (derivatives) {
      w.by_u[a] = -h * gear * pull.by_u;
      w.by_q(k, k) -= h * gear * gear * pull.by_length;
      w.by_v(k, k) -= h * gear * gear * pull.by_speed;
    }
  }
}

// Where v leads: w.increment and w.q.
template <class T>
void integrate_to_trial_state(const Model& m, const StepStart<T>& from, const T* v, Workspace<T>& w) {
  for (int k = 0; k < m.nv; ++k) {
    w.increment[k] = from.h * v[k];
    if (from.history) w.increment[k] += from.history[k] / T(3);
  }
  integrate<T>(m, from.q0, from.q_rounding, w.increment, w.q.data());
}

// Residual at (w.q, v); w.tangent = ∂g/∂v_t where derivatives are asked for. `scale` also sets w.forces, the impulses at
// work there, which Newton's tolerance refers to (they take the mass matrix of the last evaluation with derivatives).
// `found`: what w was last used for.
template <bool derivatives, class T>
void evaluate(const Model& m, const T* params, const StepStart<T>& from, const T* v, CacheState cache,
              bool add_impulses, Workspace<T>& w) {
  const T& h = from.h;
  integrate_to_trial_state<T>(m, from, v, w);
  for (int k = 0; k < m.nv; ++k) w.trial[k] = v[k] - from.v_star[k];
  w.update = w.trial / h;  // accelerations
  forward_positions<T>(m, params, w.q.data(), w);
  forward_velocities<derivatives, T>(m, params, v, w.update.data(), w);
  w.residual.setZero();
  if constexpr (derivatives) {
    w.by_q.setZero();
    w.by_v.setZero();
  }
  add_inverse_dynamics<derivatives, T>(m, params, h, v, &from, w);
  if constexpr (derivatives) w.by_v += w.mass;
  if (add_impulses) {
    for (int k = 0; k < m.nv; ++k) w.impulses[k] = h * w.mass(k, k) * (m.angular[k] ? T(98.1) : T(9.81));
  }
  subtract_joint_forces<derivatives, T>(m, params, h, w.q.data(), v, from.u, from.continuation, add_impulses, w);
  subtract_contact_forces<derivatives, T>(m, params, from, cache, add_impulses, w);
  if constexpr (derivatives) {
    w.tangent = h * w.by_q;
    times_position_by_increment<T>(m, w.increment, w.tangent);
    w.tangent += w.by_v;
  }
}

}  // namespace gelflow
