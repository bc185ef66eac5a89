// Contact law: the force of a shape on one point (eq. 8), its derivatives (eqs. 11-16), and the anchor of elastic
// friction.
//
// Equation numbers are those of the appendix of Xu et al., "Efficient Tactile Simulation with Differentiability for
// Robotic Manipulation", CoRL 2022.
//
// In the shape's frame, x the point, X its anchor, e = x − X (0 at a new contact point), v its velocity relative to the
// shape, d, n, H the distance there (d < 0 inside) with its gradient and Hessian, ḋ = n·v, v_t = v − ḋ n:
//     normal      N = max(k_n − k_d ḋ, 0) (−d)          Hunt-Crossley: scaled by depth (eq. 8 has no max and can pull)
//                 N = max(−k_n d − r k_d ḋ, 0)          linear damping, for ground contacts; r = min(−d / 1 µm, 1):
//                                                       without the ramp the step of a light, fast body has no solution
//     trial       f* = −k_t v_t                         viscous friction
//                 f* = −k_s s − k_t v_t                 elastic friction, s = tangential part of e
//     friction    f_t = f* · min(1, µN/‖f*‖)            v_t → 0 lies in the stick branch, without division; under the
//                                                       elastic law with a tolerance of rounding size, see force_terms
//     force       f = N n + f_t
// The rolling point of a sphere on a plane is not a material point and has no anchor: it follows the viscous law.
//
// Spring and damper act in parallel, in series with the slider. After a step of length h that ended in slip, the strain
// rate ṡ = (s − s_before)/h satisfies f_t = −k_s s − k_t ṡ: friction dissipates the work of the motion that the
// spring does not store. With s_before = s* − h v_t, s* the strain in f* (exact under BDF1, to second order under BDF2),
//     −k_s s = k_t v_t + q f_t + (1 − q) f*,     q = h k_s / (h k_s + k_t)
// which is −k_s s* in stick, where f_t = f* and the anchor stays. A new contact point stores nothing.
#pragma once

#include "geometry/shapes.hpp"

namespace gelflow {

// Coefficients of several points; kn, kt, kd and ks times the weight of the point, so the force at weight 0 is 0. P is a
// pack type (simd_pack.hpp).
template <class P>
struct PointLaw {
  P kn, kt, mu, kd, ks;
  P rounding;  // error of positions [m]
  DampingLaw damping;
  bool elastic;
};

template <class P>
struct PointForce {
  Vec3<P> force;
  Mat3<P> dforce_dx, dforce_dv;  // ∂force/∂(x, v)
  Mask<P> sliding;
  Vec3<P> friction, slip_velocity, trial;  // f_t, v_t, f*
};

// The terms of the force.
template <class P>
struct ForceTerms {
  P rate, normal, dnormal_ddistance, dnormal_drate;  // ḋ, N, ∂N/∂d, ∂N/∂ḋ
  P normal_offset;                                   // n·e
  Vec3<P> slip_velocity, trial;                      // v_t, f*
  Mask<P> sliding;
  P inverse, ratio;  // 1/‖f*‖ and µN/‖f*‖ where the point slides, else 1
};
template <class P>
GELFLOW_INLINE void force_terms(const PointLaw<P>& law, const Distance<P>& at, const Vec3<P>& v, const Vec3<P>& e,
                                ForceTerms<P>& p) {
  using std::sqrt;
  const P zero(0.0), one(1.0);
  const Vec3<P>& n = at.n;
  p.rate = dot(n, v);
  if (law.damping == DampingLaw::hunt_crossley) {
    const P unclipped = law.kn - law.kd * p.rate;
    const Mask<P> positive = unclipped > zero;
    const P stiffness = select(positive, unclipped, zero);
    p.normal = -stiffness * at.d;
    p.dnormal_ddistance = -stiffness;
    p.dnormal_drate = select(positive, law.kd * at.d, zero);
  } else {
    const P ramp(1e-6);  // [m]
    const Mask<P> full = at.d < -ramp;
    const P r = select(full, one, -at.d / ramp);
    const P unclipped = -law.kn * at.d - r * law.kd * p.rate;
    const Mask<P> positive = unclipped > zero;
    p.normal = select(positive, unclipped, zero);
    p.dnormal_ddistance = select(positive, select(full, zero, law.kd * p.rate / ramp) - law.kn, zero);
    p.dnormal_drate = select(positive, -r * law.kd, zero);
  }
  p.slip_velocity = v - p.rate * n;
  p.trial = -law.kt * p.slip_velocity;
  p.normal_offset = zero;
  if (law.elastic) {
    p.normal_offset = dot(n, e);
    p.trial -= law.ks * (e - p.normal_offset * n);  // e is zero where there is no anchor
  }
  const P bound = law.mu * p.normal, squared = dot(p.trial, p.trial);
  // After slip without k_t the anchor leaves the point exactly on the friction cone. The tolerance makes that stick in
  // spite of rounding errors, so that the step, its adjoint and the readings take the same branch.
  const P limit = law.elastic ? bound * (one + P(1e-14)) + law.ks * law.rounding : bound;
  p.sliding = squared > limit * limit;
  p.inverse = p.ratio = one;
  if (any(p.sliding)) {
    p.inverse = one / sqrt(select(p.sliding, squared, one));
    p.ratio = select(p.sliding, bound * p.inverse, one);
  }
}

template <bool derivatives, class P>
GELFLOW_INLINE void point_force(const PointLaw<P>& law, const Distance<P>& at, const Vec3<P>& v, const Vec3<P>& e,
                                const Mask<P>& anchored, PointForce<P>& out) {
  ForceTerms<P> p;
  force_terms(law, at, v, e, p);
  const P zero(0.0);
  const Vec3<P>& n = at.n;
  out.sliding = p.sliding;
  out.slip_velocity = p.slip_velocity;
  out.trial = p.trial;
  out.friction = p.ratio * p.trial;
  out.force = p.normal * n + out.friction;
  if constexpr (derivatives) {
    // d f* = −k_t (1 − n nᵀ) dv − k_s (1 − n nᵀ) dx + curvature terms, the second only with an anchor, and
    // d f_t = A d f* + g dN with A = 1, g = 0 (stick) or A = ratio (1 − t tᵀ), g = µ t (slip).
    const P anchor_stiffness = law.elastic ? select(anchored, law.ks, zero) : zero;
    const Vec3<P> direction = select(p.sliding, p.inverse, zero) * p.trial;
    Vec3<P> dnormal_dx = p.dnormal_ddistance * n;
    const Vec3<P> dforce_dnormal = n + law.mu * direction;  // ∂f/∂N
    // A (1 − n nᵀ) = ratio (1 − n nᵀ − t tᵀ + (t·n) t nᵀ); t·n = 0 unless n is the gradient of a grid and not of
    // unit length, see HessianForm::field.
    Mat3<P> project = p.ratio * (identity_minus_outer(n) - outer(direction, direction));
    if (at.form == HessianForm::field) [[unlikely]] {
      project += p.ratio * dot(direction, n) * outer(direction, n);
    }
    out.dforce_dv = -law.kt * project;
    out.dforce_dv += outer(dforce_dnormal, p.dnormal_drate * n);
    if (law.elastic) {
      out.dforce_dx = -anchor_stiffness * project;
    } else {
      out.dforce_dx = zero33<P>();
    }
    if (at.form != HessianForm::zero) {
      const Mat3<P> hessian = at.hessian_matrix();
      const Vec3<P> hv = hessian * v;
      dnormal_dx += p.dnormal_drate * hv;
      Mat3<P> dtrial_dx = law.kt * (outer(n, hv) + p.rate * hessian);
      if (law.elastic) dtrial_dx += anchor_stiffness * (outer(n, hessian * e) + p.normal_offset * hessian);
      out.dforce_dx += p.ratio * (dtrial_dx - outer(direction, transposed_times(dtrial_dx, direction)));
      out.dforce_dx += p.normal * hessian;
    }
    out.dforce_dx += outer(dforce_dnormal, dnormal_dx);
  }
}

// Vector-Jacobian product: carries gradients with respect to N n, f_t, f* and v_t to (x, v, X). The anchor affects
// friction only.
template <class P>
struct PointGradient {
  Vec3<P> x, v, anchor;
  Mask<P> sliding;
  Vec3<P> force;  // f
};
template <class P>
GELFLOW_INLINE PointGradient<P> point_force_vjp(const PointLaw<P>& law, const Distance<P>& at, const Vec3<P>& v,
                                                const Vec3<P>& e, const Mask<P>& anchored,
                                                const Vec3<P>& grad_normal_force, const Vec3<P>& grad_friction,
                                                const Vec3<P>& grad_trial_direct, const Vec3<P>& grad_slip) {
  ForceTerms<P> p;
  force_terms(law, at, v, e, p);
  const P zero(0.0);
  const Vec3<P>& n = at.n;
  const Vec3<P> direction = select(p.sliding, p.inverse, zero) * p.trial;
  const P grad_direction = dot(direction, grad_friction);
  const Vec3<P> grad_trial = p.ratio * (grad_friction - grad_direction * direction) + grad_trial_direct;
  const P grad_normal = dot(n, grad_normal_force) + law.mu * grad_direction;
  // v_t = v − ḋ n, f* = −k_t v_t − k_s (e − (n·e) n)
  const Vec3<P> grad_slip_total = grad_slip - law.kt * grad_trial;
  const P grad_rate = grad_normal * p.dnormal_drate - dot(n, grad_slip_total);
  PointGradient<P> g;
  g.sliding = p.sliding;
  g.force = p.normal * n + p.ratio * p.trial;
  g.v = grad_slip_total + grad_rate * n;
  g.x = grad_normal * p.dnormal_ddistance * n;
  g.anchor = zero3<P>();
  P grad_normal_offset = zero;
  if (law.elastic) {
    const P anchor_stiffness = select(anchored, law.ks, zero);
    grad_normal_offset = anchor_stiffness * dot(n, grad_trial);
    g.anchor = anchor_stiffness * grad_trial - grad_normal_offset * n;
    g.x -= g.anchor;
  }
  if (at.form != HessianForm::zero) {
    Vec3<P> grad_n = p.normal * grad_normal_force + grad_rate * v - p.rate * grad_slip_total;
    if (law.elastic) grad_n += grad_normal_offset * e + select(anchored, law.ks, zero) * p.normal_offset * grad_trial;
    g.x += at.hessian_times(grad_n);
  }
  return g;
}

// q (see the head of this file).
template <class P>
GELFLOW_INLINE P relaxation_factor(const PointLaw<P>& law, const P& step_length) {
  const P spring = step_length * law.ks, both = spring + law.kt;
  return spring / select(both > P(0.0), both, P(1.0));
}

// Anchor after an accepted step, for an active point (else it is cleared).
template <class P>
GELFLOW_INLINE Vec3<P> next_anchor(const PointLaw<P>& law, const P& step_length, const PointForce<P>& f,
                                   const Vec3<P>& x, const Vec3<P>& anchor, const Mask<P>& anchored) {
  const P stiffness = select(law.ks > P(0.0), law.ks, P(1.0));  // at weight 0 the result is not used
  const P q = relaxation_factor(law, step_length);
  const Vec3<P> s = -(P(1.0) / stiffness) * (law.kt * f.slip_velocity + q * f.friction + (P(1.0) - q) * f.trial);
  return select3<P>(anchored, select3<P>(f.sliding, x - s, anchor), x);
}

// Vector-Jacobian product of `next_anchor`: carries the gradient λ of the anchor after the step to (x, v, X).
template <class P>
GELFLOW_INLINE PointGradient<P> next_anchor_vjp(const PointLaw<P>& law, const P& step_length, const Distance<P>& at,
                                                const Vec3<P>& v, const Vec3<P>& e, const Mask<P>& anchored,
                                                const Vec3<P>& lambda) {
  const P zero(0.0), one(1.0), stiffness = select(law.ks > zero, law.ks, one), q = relaxation_factor(law, step_length);
  const Vec3<P> none = zero3<P>(), scaled = one / stiffness * lambda;
  PointGradient<P> g = point_force_vjp(law, at, v, e, anchored, none, q * scaled, (one - q) * scaled, law.kt * scaled);
  const Mask<P> relaxes = g.sliding && anchored;
  g.x = select3<P>(relaxes, g.x + lambda, select3<P>(anchored, none, lambda));
  g.v = select3<P>(relaxes, g.v, none);
  g.anchor = select3<P>(relaxes, g.anchor, select3<P>(anchored, lambda, none));
  return g;
}

}  // namespace gelflow
