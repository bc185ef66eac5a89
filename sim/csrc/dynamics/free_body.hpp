// The share of a free body that carries nothing in the part M(q) a + C(q, v) − Jᵀ gravity of the residual.
//
// In the body's own frame, with c and the inertia J about it constant there, a the acceleration of the frame's origin less
// gravity g (world), ω and α in the body's frame, y what the centre of mass accelerates besides:
//     force F (world)  m (a + R y)                moment (body)  J α + ω × J ω + c × Rᵀ F
//     y = α × c + ω × (ω × c)
//
// Over a step of length h that ends with the turn θ (h is β h, and θ = β h ω + γ δ) y is what the centre of mass has gained
// in velocity. Then linear momentum is kept whatever frame the body has:
//     y = (ω × c − u)/h,     u = exp(−[θ]×) (ω* × c + z),     z = 0 under BDF1
//     BDF2: ω* = 4/3 ω_{t-1} − 1/3 ω_{t-2} lacks that ω_{t-2} spoke in axes before δ: z = 1/3 (1 − exp(−[δ]×)) (ω_{t-2} × c)
// Under BDF1 weight acts along the arc that the centre of mass takes (arc_correction.hpp): the moment gains (N c) × (−m Rᵀ g).
//
// Derivatives, besides M by v_t:
//     F by φ       −m R [y]×              moment   m [c]× [Rᵀ a]× − m [N c]× [Rᵀ g]×
//     F by θ       −m/h R [u]× Jr(θ)      moment   m/h (−[c]× [u]× Jr(θ)) − m Σ_j (∂N/∂θ_j c) × Rᵀ g e_jᵀ
//     moment by ω  [ω]× J − [J ω]×
#pragma once

#include "contact/arc_moment_arm.hpp"
#include "dynamics/kinematics.hpp"

namespace gelflow {

// u and what it depends on.
template <class T>
struct CenterBefore {
  M3<T> back;  // exp(−[θ]×)
  V3<T> u;
};
template <class T>
M3<T> turn_back(const V3<T>& turn) {
  return rotation_of<T>(quaternion_exp<T>(turn)).transpose();
}
template <class T>
CenterBefore<T> center_before(const StepStart<T>& from, int nv, int turn, const V3<T>& c, const Workspace<T>& w) {
  V3<T> velocity = cross<T>(vec3(from.v_star + turn), c);
  if (from.history != nullptr) {
    const V3<T> earlier = cross<T>(vec3(from.history + nv + turn), c);
    velocity += (earlier - turn_back<T>(vec3(from.history + turn)) * earlier) / T(3);
  }
  const M3<T> back = turn_back<T>(vec3(w.increment.data() + turn));
  return {back, back * velocity};
}

template <bool derivatives, class T>
void add_free_body(const Model& m, const Body& body, const T* params, const T& h, const T* v, const StepStart<T>* from,
                   Workspace<T>& w) {
  const int k = m.joints[body.joint_begin].v;
  const T* n = params + body.mass;
  const T mass = n[0];
  const M3<T>& r = as<T>(w.rotation[&body - m.bodies.data()]);
  const V3<T> c = vec3(n + 1), spin = vec3(v + k + 3), spin_rate = vec3(w.update.data() + k + 3);
  const V3<T> gravity = vec3(params + m.gravity), a = vec3(w.update.data() + k) - gravity;
  M3<T> inertia;
  inertia << n[4], n[7], n[8], n[7], n[5], n[9], n[8], n[9], n[6];
  const V3<T> angular_momentum = inertia * spin;
  V3<T> force = mass * a, moment = inertia * spin_rate + cross<T>(spin, angular_momentum);
  const bool centered = std::is_floating_point_v<T> && c == V3<T>::Zero(),
             uses_arc_correction = from && from->history == nullptr;
  CenterBefore<T> before;
  V3<T> y;
  if (!centered) {
    if (from) before = center_before<T>(*from, m.nv, k + 3, c, w);
    y = from ? V3<T>((cross<T>(spin, c) - before.u) / h)
             : V3<T>(cross<T>(spin_rate, c) + cross<T>(spin, cross<T>(spin, c)));
    force += mass * (r * y);
    moment += cross<T>(c, r.transpose() * force);
  }
  const V3<T> weight = -mass * (r.transpose() * gravity), turn = vec3(w.increment.data() + k + 3);
  if (!centered && uses_arc_correction) moment += cross<T>(MomentArmCorrection<T>(turn, false).value * c, weight);
  for (int i = 0; i < 3; ++i) {
    w.residual[k + i] += h * force[i];
    w.residual[k + 3 + i] += h * moment[i];
  }
  if constexpr (derivatives) {
    for (int i = 0; i < 3; ++i) w.mass(k + i, k + i) = mass;
    w.by_v.template block<3, 3>(k + 3, k + 3) += h * (cross_columns<T>(spin, inertia) - skew<T>(angular_momentum));
    if (centered) {  // not so for another environment, perhaps
      w.mass.template block<3, 3>(k + 3, k + 3) = inertia;
      w.mass.template block<3, 3>(k, k + 3).setZero();
      w.mass.template block<3, 3>(k + 3, k).setZero();
      return;
    }
    const M3<T> lever = skew<T>(c), turned = mass * r;
    w.mass.template block<3, 3>(k + 3, k + 3) = inertia - mass * (lever * lever);
    w.mass.template block<3, 3>(k, k + 3) = -turned * lever;
    w.mass.template block<3, 3>(k + 3, k) = lever * turned.transpose();
    if (!from) return;
    w.by_q.template block<3, 3>(k, k + 3) -= h * (turned * skew<T>(y));
    w.by_q.template block<3, 3>(k + 3, k + 3) += h * mass * (lever * skew<T>(r.transpose() * a));
    const M3<T> by_turn = h * (skew<T>(before.u) * right_jacobian<T>(turn));
    w.by_v.template block<3, 3>(k, k + 3) -= turned * by_turn;
    w.by_v.template block<3, 3>(k + 3, k + 3) -= mass * (lever * by_turn);
    if (!uses_arc_correction) return;
    const MomentArmCorrection<T> arc(turn, true);
    w.by_q.template block<3, 3>(k + 3, k + 3) += h * (skew<T>(arc.value * c) * skew<T>(weight));
    for (int j = 0; j < 3; ++j) {
      w.by_v.template block<3, 1>(k + 3, k + 3 + j) += h * h * cross<T>(arc.by[j] * c, weight);
    }
  }
}

// What M leaves out of −(∂g/∂v*)ᵀ, −(∂g/∂(γ δ))ᵀ and −(∂g/∂v_{t-2})ᵀ times the multipliers: g depends on these by u too.
template <class T>
void free_bodies_vjp(const Model& m, const T* params, const StepStart<T>& from, const Workspace<T>& w,
                     const VX<T>& multipliers, VX<T>& by_v_star, VX<T>& by_shift, VX<T>& by_earlier) {
  for (std::size_t i = 0; i < m.bodies.size(); ++i) {
    const Body& body = m.bodies[i];
    const V3<T> c = vec3(params + body.mass + 1);
    if (!body.is_free || c == V3<T>::Zero()) continue;
    const int turn = m.joints[body.joint_begin].v + 3;
    const CenterBefore<T> before = center_before<T>(from, m.nv, turn, c, w);
    const V3<T> push = as<T>(w.rotation[i]).transpose() * vec3(multipliers.data() + turn - 3);
    const V3<T> by_u = params[body.mass] * (push + cross<T>(vec3(multipliers.data() + turn), c));
    const V3<T> by_velocity = before.back.transpose() * by_u;
    by_v_star.template segment<3>(turn) += cross<T>(c, by_velocity - by_u);
    if (from.history == nullptr) continue;
    const V3<T> theta = vec3(w.increment.data() + turn), delta = vec3(from.history + turn);
    const V3<T> earlier = cross<T>(vec3(from.history + m.nv + turn), c), third = by_velocity / T(3);
    const M3<T> back = turn_back<T>(delta);
    by_earlier.template segment<3>(turn) += cross<T>(c, third - back.transpose() * third);
    const V3<T> by_delta = right_jacobian<T>(delta).transpose() * cross<T>(back * earlier, third);
    by_shift.template segment<3>(turn) +=
        T(3) * by_delta - right_jacobian<T>(theta).transpose() * cross<T>(before.u, by_u);
  }
}

}  // namespace gelflow
