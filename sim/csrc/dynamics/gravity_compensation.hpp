// Gravity compensation: a constant force f = −factor · m g at a point of a body, like MuJoCo's `gravcomp`.
//
// With e_k = v_k + ω_k × x the velocity of the point x by dof k, the generalized force is e_k · f and its derivative
//     ∂(e_k · f)/∂q_j = (ω_j × e_k) · f   if j moves the axis of k,   else (ω_k × e_j) · f
// A free body is computed in its own frame, with the lever r from its origin: moment r × Rᵀ f. Under BDF1 the force acts
// along the arc of the point, as the weight does (free_body.hpp): r gains N r.
#pragma once

#include "dynamics/kinematics.hpp"
#include "math/moment_arm_correction.hpp"

namespace gelflow {

template <class T>
struct CompensatingForce {
  V3<T> force;  // in the world
  V3<T> lever;  // of its point, in the body frame
};
template <class T>
CompensatingForce<T> compensating_force(const Model& m, const Body& body, const T* params) {
  const BodyParams<T>& own = body.params.in(params);
  const GravityCompensationParams<T>& compensation = body.compensation.in(params);
  const T mass = -compensation.factor * own.mass;
  return {V3<T>(mass * m.gravity.in(params).acceleration), V3<T>(own.com + compensation.pos)};
}

template <bool derivatives, class T>
void subtract_free_compensation(const Model& m, const Body& body, const CompensatingForce<T>& at,
                                const StepStart<T>& start, Workspace<T>& w) {
  const T& beta_h = start.beta_h;
  const int k = m.joints[body.joint_begin].v;
  const M3<T> rotation = as<T>(w.rotation[&body - m.bodies.data()]);
  const V3<T> local = rotation.transpose() * at.force;
  V3<T> lever = at.lever;
  const bool arc = start.history == nullptr;
  const MomentArmCorrection<T> correction(vec3(w.increment.data() + k + 3), derivatives && arc);
  if (arc) lever += correction.value * at.lever;
  const V3<T> moment = cross<T>(lever, local);
  for (int i = 0; i < 3; ++i) {
    w.residual[k + i] -= beta_h * at.force[i];
    w.residual[k + 3 + i] -= beta_h * moment[i];
  }
  if constexpr (derivatives) {
    w.dg_dq.template block_in_tree<3>(k + 3, k + 3) -= beta_h * (skew<T>(lever) * skew<T>(local));
    for (int j = 0; arc && j < 3; ++j) {
      w.dg_dv.template block_in_tree<1>(k + 3, k + 3 + j) -=
          beta_h * beta_h * cross<T>(correction.derivative[j] * at.lever, local);
    }
  }
}

template <bool derivatives, class T>
void subtract_articulated_compensation(const Model& m, int i, const CompensatingForce<T>& at, const T& beta_h,
                                       Workspace<T>& w) {
  const V3<T> point = as<T>(w.position[i]) + as<T>(w.rotation[i]) * at.lever;
  const auto angular = [&](int k) { return V3<T>(top(w.axis[k])); };
  const auto velocity = [&](int k) { return V3<T>(bottom(w.axis[k]) + cross<T>(angular(k), point)); };
  for (const int k : m.bodies[i].dofs) {
    w.residual[k] -= beta_h * velocity(k).dot(at.force);
    if constexpr (derivatives) {
      for (const int j : m.bodies[i].dofs) {
        const bool moves_axis = m.is_ancestor(j, k);
        const V3<T> change = moves_axis ? cross<T>(angular(j), velocity(k)) : cross<T>(angular(k), velocity(j));
        w.dg_dq.in_tree(k, j) -= beta_h * change.dot(at.force);
      }
    }
  }
}

// Subtracts β h · (gravity compensation) from w.residual; with derivatives also from w.dg_dq and w.dg_dv.
template <bool derivatives, class T>
void subtract_gravity_compensation(const Model& m, const T* params, const StepStart<T>& start, Workspace<T>& w) {
  for (const int i : m.compensated_bodies) {
    const CompensatingForce<T> at = compensating_force<T>(m, m.bodies[i], params);
    if (m.bodies[i].is_free) {
      subtract_free_compensation<derivatives, T>(m, m.bodies[i], at, start, w);
    } else {
      subtract_articulated_compensation<derivatives, T>(m, i, at, start.beta_h, w);
    }
  }
}

}  // namespace gelflow
