// Correction of the moment arm of spring forces between a free body and a plane of the world, under BDF1.
//
// Over a step the body's origin moves by h v and the body rotates by θ = h ω. A point at r from the origin (world axes,
// at the step's end) moves along an arc,
//     x − x_before = h v + θ × B r,     B = ∫₀¹ exp(−s [θ]×) ds = Jr(θ)
// and not by h (v + ω × r). If the spring force p has the moment r × p, its work belongs to the second displacement, the
// stored energy to the first: a body that rotates fast gains energy. With the moment (B r) × p the work in the step is
// p · (x − x_before), which is at least the decrease of the stored energy, so BDF1 never adds energy. Damping and
// friction dissipate along h (v + ω × r), with the moment r × f. Therefore only the springs contribute
//     m = Σ (N r) × p,     N = B − 1,     p = −k_n d n − k_s s
// with s the strain after the step (contact_law.hpp). For a sphere's rolling point, r is that of its centre.
//
// Derivatives. In the shape's frame, with a displacement (φ, δ) of the body and changes (ω', v') of its velocities there,
// including the rotation of the body's frame, u = ω × r, N_j = ∂N/∂θ_j, Q = Σ r pᵀ and a(M) = Σ_ij M_ij e_i × e_j:
//     dr = φ × r,   dx = δ + dr,   dv = v' + ω' × r + φ × u,   dθ = h (φ × ω + ω')
//     dm = Σ_j a(N_j Q) dθ_j + a(N [φ]× Q) + Σ [N r]× (∂p/∂x dx + ∂p/∂v dv)
#pragma once

#include "contact/contact_point_loops.hpp"
#include "math/moment_arm_correction.hpp"

namespace gelflow {

// a(M): the moment of Σ r pᵀ = M.
template <class T>
V3<T> moment_of(const M3<T>& m) {
  return {m(1, 2) - m(2, 1), m(2, 0) - m(0, 2), m(0, 1) - m(1, 0)};
}

// Spring force of a point: p, ∂p/∂x, ∂p/∂v.
template <class P>
struct SpringForce {
  Vec3<P> force;
  Mat3<P> dforce_dx, dforce_dv;
};
template <bool derivatives, class T>
GELFLOW_INLINE SpringForce<Pack<T>> spring_force(const ContactPack<T>& t, const T& step_length) {
  using P = Pack<T>;
  SpringForce<P> s{-(t.law.kn * t.at.d) * t.at.n, zero33<P>(), zero33<P>()};
  s.dforce_dx.row[2].z = -t.law.kn;  // n = z
  if (!t.law.elastic) return s;
  // −k_s s = k_t v_t + q f_t + (1 − q) f*
  PointForce<P> f;
  point_force<derivatives>(t.law, t.at, t.v, t.e, t.has_anchor, f);
  const P zero(0.0), q = relaxation_factor(t.law, P(step_length)), rest = P(1.0) - q;
  const auto if_anchored = [&](const P& x) GELFLOW_LOOP_BODY { return select(t.has_anchor, x, zero); };
  const Vec3<P> e = t.law.kt * f.slip_velocity + q * f.friction + rest * f.trial;
  s.force.x += if_anchored(e.x);
  s.force.y += if_anchored(e.y);
  if constexpr (derivatives) {
    for (int i = 0; i < 2; ++i) {
      Vec3<P> dforce_dx = q * f.dforce_dx.row[i], dforce_dv = q * f.dforce_dv.row[i];
      (i == 0 ? dforce_dx.x : dforce_dx.y) -= rest * t.law.ks;
      (i == 0 ? dforce_dv.x : dforce_dv.y) += q * t.law.kt;
      s.dforce_dx.row[i] = {if_anchored(dforce_dx.x), if_anchored(dforce_dx.y), if_anchored(dforce_dx.z)};
      s.dforce_dv.row[i] = {if_anchored(dforce_dv.x), if_anchored(dforce_dv.y), if_anchored(dforce_dv.z)};
    }
  }
  return s;
}

template <class T>
M3<T> sum33(const Mat3<Pack<T>>& m) {
  M3<T> out;
  for (int i = 0; i < 3; ++i) out.row(i) = sum3<T>(m.row[i]).transpose();
  return out;
}

// Origin of the body in the shape's frame.
template <class T>
V3<T> body_origin_in_shape(const PairFrame<T>& frame, int body, const Workspace<T>& w) {
  return frame.to_world.transpose() *
         as<T>(V3<PositionScalar<T>>(w.position[body] - frame.origin.template cast<PositionScalar<T>>()));
}

// Sums over the contact points in the shape's frame: Q, and the derivatives of m by δ, φ (at constant N), v' and ω'.
template <class T>
struct ArcSums {
  M3<T> outer, dmoment_dtranslation, dmoment_drotation, dmoment_dlinear, dmoment_dangular;
};
template <bool derivatives, class T>
GELFLOW_INLINE void sum_springs(const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                                const ContactSettings<T>& settings, const M3<T>& arm, const V3<T>& body_origin,
                                ArcSums<T>& sums) {
  using P = Pack<T>;
  const Mat3<P> n = broadcast<P>(arm);
  const Vec3<P> origin = broadcast<P>(body_origin), angular = broadcast<P>(frame.angular);
  Mat3<P> outer_sum = zero33<P>(), dmoment_dtranslation = outer_sum, dmoment_drotation = outer_sum,
          dmoment_dlinear = outer_sum, dmoment_dangular = outer_sum;
  for_contact_points<false, T>(frame, candidates, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    const Vec3<P> r = t.center - origin;
    const SpringForce<P> s = spring_force<derivatives, T>(t, settings.step_length);
    outer_sum += outer(r, s.force);
    if constexpr (derivatives) {
      const Vec3<P> corrected = n * r;
      const Mat3<P> x = cross_columns(corrected, s.dforce_dx);
      dmoment_dtranslation += x;
      dmoment_drotation -= cross_rows(x, r);
      if (!t.law.elastic) return;
      const Mat3<P> v = cross_columns(corrected, s.dforce_dv);
      dmoment_dlinear += v;
      dmoment_dangular -= cross_rows(v, r);
      dmoment_drotation -= cross_rows(v, cross(angular, r));
    }
  });
  sums.outer = sum33<T>(outer_sum);
  if constexpr (derivatives) {
    sums.dmoment_dtranslation = sum33<T>(dmoment_dtranslation);
    sums.dmoment_drotation = sum33<T>(dmoment_drotation);
    sums.dmoment_dlinear = sum33<T>(dmoment_dlinear);
    sums.dmoment_dangular = sum33<T>(dmoment_dangular);
  }
}

// Subtracts h m from w.residual; with derivatives also from w.dg_dq and w.dg_dv.
template <bool derivatives, class T>
void subtract_arc_correction(const Model& m, int body, const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                             const ContactSettings<T>& settings, Workspace<T>& w) {
  const T& step_length = settings.step_length;
  const MomentArmCorrection<T> arm(step_length * frame.angular, derivatives);
  ArcSums<T> sums;
  sum_springs<derivatives, T>(frame, candidates, settings, arm.value, body_origin_in_shape<T>(frame, body, w), sums);
  const int k = m.joints[m.bodies[body].joint_begin].v;
  const M3<T>& q = sums.outer;
  const M3<T> rotation = frame.to_world.transpose() * as<T>(w.rotation[body]);
  const V3<T> moment = rotation.transpose() * moment_of<T>(arm.value * q);
  for (int i = 0; i < 3; ++i) w.residual[k + 3 + i] -= step_length * moment[i];
  if constexpr (derivatives) {
    M3<T> dmoment_dtheta, dmoment_drotation = sums.dmoment_drotation;
    for (int j = 0; j < 3; ++j) {
      dmoment_dtheta.col(j) = moment_of<T>(arm.derivative[j] * q);
      dmoment_drotation.col(j) += moment_of<T>(arm.value * skew<T>(V3<T>(V3<T>::Unit(j))) * q);
    }
    dmoment_drotation -= step_length * (dmoment_dtheta * skew<T>(frame.angular));
    const M3<T> to_body = step_length * rotation.transpose();
    w.dg_dq.template block_in_tree<3>(k + 3, k) -= to_body * sums.dmoment_dtranslation * frame.to_world.transpose();
    w.dg_dq.template block_in_tree<3>(k + 3, k + 3) -=
        step_length * skew<T>(moment) + to_body * dmoment_drotation * rotation;
    w.dg_dv.template block_in_tree<3>(k + 3, k) -= to_body * sums.dmoment_dlinear * frame.to_world.transpose();
    w.dg_dv.template block_in_tree<3>(k + 3, k + 3) -=
        to_body * (sums.dmoment_dangular + step_length * dmoment_dtheta) * rotation;
  }
}

}  // namespace gelflow
