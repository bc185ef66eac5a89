// A free body without children in the part M(q) a + C(q, v) − Jᵀ gravity of the residual.
//
// In the body frame, where the centre of mass c and the inertia J about it are constant; a is the acceleration of the
// frame's origin minus gravity g (world), ω and α are in the body frame, y is the acceleration of the centre of mass
// relative to the origin:
//     force F (world)  m (a + R y)                moment (body)  J α + ω × J ω + c × Rᵀ F
//     y = α × c + ω × (ω × c)
//
// Over a step that ends with the rotation θ = β h ω + γ δ (`beta_h` is β h), y is the change of the velocity
// of the centre of mass, which conserves linear momentum for any choice of the body frame:
//     y = (ω × c − u)/(β h),     u = exp(−[θ]×) (ω* × c + z),     z = 0 under BDF1
//     BDF2: ω* = 4/3 ω_{t-1} − 1/3 ω_{t-2}, where ω_{t-2} refers to the axes before δ: z = 1/3 (1 − exp(−[δ]×)) (ω_{t-2} × c)
// Under BDF1 the weight acts along the arc of the centre of mass (arc_correction.hpp): the moment gains (N c) × (−m Rᵀ g).
//
// Derivatives, in addition to M (by v_t):
//     F by φ       −m R [y]×              moment   m [c]× [Rᵀ a]× − m [N c]× [Rᵀ g]×
//     F by θ       −m/(β h) R [u]× Jr(θ)  moment   m/(β h) (−[c]× [u]× Jr(θ)) − m Σ_j (∂N/∂θ_j c) × Rᵀ g e_jᵀ
//     moment by ω  [ω]× J − [J ω]×
#pragma once

#include "dynamics/kinematics.hpp"
#include "math/moment_arm_correction.hpp"

namespace gelflow {

template <class T>
struct CenterVelocity {
  M3<T> inverse_rotation;  // exp(−[θ]×)
  V3<T> u;
};
template <class T>
M3<T> inverse_rotation(const V3<T>& rotation_vector) {
  return rotation_of<T>(quaternion_exp<T>(rotation_vector)).transpose();
}
// `k`: first rotational dof of the body.
template <class T>
CenterVelocity<T> previous_center_velocity(const StepStart<T>& start, int nv, int k, const V3<T>& c,
                                           const Workspace<T>& w) {
  V3<T> velocity = cross<T>(vec3(start.v_star + k), c);
  if (start.history != nullptr) {
    const V3<T> earlier = cross<T>(vec3(start.history + nv + k), c);
    velocity += (earlier - inverse_rotation<T>(vec3(start.history + k)) * earlier) / T(3);
  }
  const M3<T> inverse = inverse_rotation<T>(vec3(w.increment.data() + k));
  return {inverse, inverse * velocity};
}

// Views of the terms of a free body's dynamics that its residual and the derivatives share. References: copies would be
// stored to memory in evaluations without derivatives too.
template <class T>
struct FreeBodyTerms {
  int k;          // first dof
  bool centered;  // c is zero, and no derivatives by c are wanted
  const T& mass;
  const M3<T>&rotation, &inertia;
  const V3<T>&c, &spin, &acceleration;  // spin: ω; acceleration: a
  const V3<T>&weight, &turn;            // weight: −m Rᵀ g; turn: θ
  const V3<T>&angular_momentum, &y;
  const CenterVelocity<T>& before;
};

// Derivatives of a free body's force and moment. `start`: see add_inverse_dynamics.
template <class T>
GELFLOW_INLINE void add_free_body_derivatives(const FreeBodyTerms<T>& b, const T& beta_h, const StepStart<T>* start,
                                              Workspace<T>& w) {
  const int k = b.k;
  for (int i = 0; i < 3; ++i) w.mass.in_tree(k + i, k + i) = b.mass;
  w.dg_dv.template block_in_tree<3>(k + 3, k + 3) +=
      beta_h * (cross_columns<T>(b.spin, b.inertia) - skew<T>(b.angular_momentum));
  if (b.centered) {  // another environment may have another centre of mass: blocks are set, not assumed zero
    w.mass.template block_in_tree<3>(k + 3, k + 3) = b.inertia;
    w.mass.template block_in_tree<3>(k, k + 3).setZero();
    w.mass.template block_in_tree<3>(k + 3, k).setZero();
    return;
  }
  const M3<T> arm = skew<T>(b.c), turned = b.mass * b.rotation;
  w.mass.template block_in_tree<3>(k + 3, k + 3) = b.inertia - b.mass * (arm * arm);
  w.mass.template block_in_tree<3>(k, k + 3) = -turned * arm;
  w.mass.template block_in_tree<3>(k + 3, k) = arm * turned.transpose();
  if (!start) return;
  w.dg_dq.template block_in_tree<3>(k, k + 3) -= beta_h * (turned * skew<T>(b.y));
  w.dg_dq.template block_in_tree<3>(k + 3, k + 3) +=
      beta_h * b.mass * (arm * skew<T>(b.rotation.transpose() * b.acceleration));
  const M3<T> jac_turn = beta_h * (skew<T>(b.before.u) * right_jacobian<T>(b.turn));
  w.dg_dv.template block_in_tree<3>(k, k + 3) -= turned * jac_turn;
  w.dg_dv.template block_in_tree<3>(k + 3, k + 3) -= b.mass * (arm * jac_turn);
  if (start->history != nullptr) return;
  const MomentArmCorrection<T> arc(b.turn, true);
  w.dg_dq.template block_in_tree<3>(k + 3, k + 3) += beta_h * (skew<T>(arc.value * b.c) * skew<T>(b.weight));
  for (int j = 0; j < 3; ++j) {
    w.dg_dv.template block_in_tree<1>(k + 3, k + 3 + j) +=
        beta_h * beta_h * cross<T>(arc.derivative[j] * b.c, b.weight);
  }
}

template <bool derivatives, class T>
void add_free_body(const Model& m, const Body& body, const T* params, const T& beta_h, const T* v,
                   const StepStart<T>* start, Workspace<T>& w) {
  const int k = m.joints[body.joint_begin].v;
  const BodyParams<T>& own = body.params.in(params);
  const T mass = own.mass;
  const M3<T>& rotation = as<T>(w.rotation[&body - m.bodies.data()]);
  const M3<T> inertia = own.inertia();
  const V3<T> c = own.com, gravity = m.gravity.in(params).acceleration;
  const V3<T> spin = vec3(v + k + 3), spin_rate = vec3(w.generalized_acceleration.data() + k + 3);
  const V3<T> acceleration = vec3(w.generalized_acceleration.data() + k) - gravity;
  const V3<T> angular_momentum = inertia * spin;
  V3<T> force = mass * acceleration, moment = inertia * spin_rate + cross<T>(spin, angular_momentum);
  const bool centered = std::is_floating_point_v<T> && c == V3<T>::Zero();
  CenterVelocity<T> before;
  V3<T> y;
  if (!centered) {
    if (start) before = previous_center_velocity<T>(*start, m.nv, k + 3, c, w);
    y = start ? V3<T>((cross<T>(spin, c) - before.u) / beta_h)
              : V3<T>(cross<T>(spin_rate, c) + cross<T>(spin, cross<T>(spin, c)));
    force += mass * (rotation * y);
    moment += cross<T>(c, rotation.transpose() * force);
  }
  const V3<T> weight = -mass * (rotation.transpose() * gravity), turn = vec3(w.increment.data() + k + 3);
  const bool uses_arc_correction = !centered && start && start->history == nullptr;
  if (uses_arc_correction) moment += cross<T>(MomentArmCorrection<T>(turn, false).value * c, weight);
  for (int i = 0; i < 3; ++i) {
    w.residual[k + i] += beta_h * force[i];
    w.residual[k + 3 + i] += beta_h * moment[i];
  }
  if constexpr (derivatives) {
    const FreeBodyTerms<T> terms{k,    centered,         mass, rotation, inertia, c, spin, acceleration, weight,
                                 turn, angular_momentum, y,    before};
    add_free_body_derivatives<T>(terms, beta_h, start, w);
  }
}

// The terms of −(∂g/∂v*)ᵀ, −(∂g/∂(γ δ))ᵀ and −(∂g/∂v_{t-2})ᵀ times the multipliers that M does not contain: g depends
// on these through u too.
template <class T>
void free_bodies_vjp(const Model& m, const T* params, const StepStart<T>& start, const Workspace<T>& w,
                     const VX<T>& multipliers, VX<T>& grad_v_star, VX<T>& grad_shift, VX<T>& grad_earlier) {
  for (std::size_t i = 0; i < m.bodies.size(); ++i) {
    const Body& body = m.bodies[i];
    const V3<T> c = body.params.in(params).com;
    if (!body.is_free || c == V3<T>::Zero()) continue;
    const int turn = m.joints[body.joint_begin].v + 3;
    const CenterVelocity<T> before = previous_center_velocity<T>(start, m.nv, turn, c, w);
    const V3<T> force = as<T>(w.rotation[i]).transpose() * vec3(multipliers.data() + turn - 3);
    const V3<T> grad_u = body.params.in(params).mass * (force + cross<T>(vec3(multipliers.data() + turn), c));
    const V3<T> grad_velocity = before.inverse_rotation.transpose() * grad_u;
    grad_v_star.template segment<3>(turn) += cross<T>(c, grad_velocity - grad_u);
    if (start.history == nullptr) continue;
    const V3<T> theta = vec3(w.increment.data() + turn), delta = vec3(start.history + turn);
    const V3<T> earlier = cross<T>(vec3(start.history + m.nv + turn), c), third = grad_velocity / T(3);
    const M3<T> inverse = inverse_rotation<T>(delta);
    grad_earlier.template segment<3>(turn) += cross<T>(c, third - inverse.transpose() * third);
    const V3<T> grad_delta = right_jacobian<T>(delta).transpose() * cross<T>(inverse * earlier, third);
    grad_shift.template segment<3>(turn) +=
        T(3) * grad_delta - right_jacobian<T>(theta).transpose() * cross<T>(before.u, grad_u);
  }
}

}  // namespace gelflow
