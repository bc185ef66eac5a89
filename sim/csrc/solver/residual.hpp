// The residual g of one implicit step (step.hpp) and its derivatives,
//
//     g(v_t) = β h · (inverse dynamics of (q_t, v_t, (v_t − v*)/(β h)) − f),    q_t = q_{t-1} ⊕ (β h v_t + γ δ)
//
// with h the step length; `beta_h` is β h.
#pragma once

#include "dynamics/gravity_compensation.hpp"
#include "dynamics/inverse_dynamics.hpp"
#include "solver/islands.hpp"
#include "solver/joint_forces.hpp"
#include "solver/loop_closures.hpp"
#include "solver/polynomial_couplings.hpp"

namespace gelflow {

// Integrates v to the trial configuration: w.increment and w.q.
template <class T>
void integrate_to_trial_state(const Model& m, const StepStart<T>& start, const T* v, Workspace<T>& w) {
  for (int k = 0; k < m.nv; ++k) {
    w.increment[k] = start.beta_h * v[k];
    if (start.history) w.increment[k] += start.history[k] / T(3);
  }
  integrate<T>(m, start.q0, start.q_rounding, w.increment, w.q.data());
}

// Evaluates the residual at v, and with derivatives w.tangent = ∂g/∂v_t. `add_impulses` also sets w.impulses, the
// absolute impulses that the tolerance of Newton's method refers to (with the mass matrix of the last evaluation with
// derivatives). `cache`: the state of the candidate points in w.
template <bool derivatives, class T>
void evaluate(const Model& m, const T* params, const StepStart<T>& start, const T* v, CacheState cache,
              bool add_impulses, Workspace<T>& w) {
  const T& beta_h = start.beta_h;
  integrate_to_trial_state<T>(m, start, v, w);
  for (int k = 0; k < m.nv; ++k) w.velocity_change[k] = v[k] - start.v_star[k];
  w.generalized_acceleration = w.velocity_change / beta_h;
  forward_positions<T>(m, params, w.q.data(), w);
  forward_velocities<derivatives, T>(m, params, v, w.generalized_acceleration.data(), w);
  w.residual.setZero();
  if constexpr (derivatives) {
    if (m.has_islands) find_islands<T>(m, params, start, cache, w);
    w.dg_dq.set_zero();
    w.dg_dv.set_zero();
    if (!m.tendons.empty()) w.mass.set_zero();  // their entries are in no tree
  }
  add_inverse_dynamics<derivatives, T>(m, params, beta_h, v, &start, w);
  if constexpr (derivatives) {
    add_tendon_mass<T>(m, params, w);
    w.dg_dv.values() += w.mass.values();
  }
  if (add_impulses) {
    for (int k = 0; k < m.nv; ++k) w.impulses[k] = beta_h * w.mass.in_tree(k, k) * (m.angular[k] ? T(98.1) : T(9.81));
  }
  if (!m.compensated_bodies.empty()) subtract_gravity_compensation<derivatives, T>(m, params, start, w);
  subtract_joint_forces<derivatives, T>(m, params, beta_h, w.q.data(), v, start.u, start.continuation, add_impulses, w);
  subtract_polynomial_couplings<derivatives, T>(m, params, beta_h, w.q.data(), v, add_impulses, w);
  subtract_contact_forces<derivatives, T>(m, params, start, cache, add_impulses, w);
  subtract_loop_closures<derivatives, T>(m, params, beta_h, add_impulses, w);
  if constexpr (derivatives) {
    w.tangent.values() = beta_h * w.dg_dq.values();
    times_dposition_dincrement<T>(m, w.increment, w.layout, w.tangent);
    w.tangent.values() += w.dg_dv.values();
  }
}

}  // namespace gelflow
