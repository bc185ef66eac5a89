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
  Mat3<P> by_x, by_v;
};
template <bool derivatives, class T>
GELFLOW_INLINE SpringForce<Pack<T>> spring_force(const ContactPack<T>& t, const T& step_length) {
  using P = Pack<T>;
  SpringForce<P> s{-(t.law.kn * t.at.d) * t.at.n, zero33<P>(), zero33<P>()};
  s.by_x.row[2].z = -t.law.kn;  // n = z
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
      Vec3<P> by_x = q * f.by_x.row[i], by_v = q * f.by_v.row[i];
      (i == 0 ? by_x.x : by_x.y) -= rest * t.law.ks;
      (i == 0 ? by_v.x : by_v.y) += q * t.law.kt;
      s.by_x.row[i] = {if_anchored(by_x.x), if_anchored(by_x.y), if_anchored(by_x.z)};
      s.by_v.row[i] = {if_anchored(by_v.x), if_anchored(by_v.y), if_anchored(by_v.z)};
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
  M3<T> outer, by_translation, by_rotation, by_linear, by_angular;
};
template <bool derivatives, class T>
GELFLOW_INLINE void sum_springs(const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                                const ContactSettings<T>& settings, const M3<T>& arm, const V3<T>& body_origin,
                                ArcSums<T>& sums) {
  using P = Pack<T>;
  const Mat3<P> n = broadcast<P>(arm);
  const Vec3<P> origin = broadcast<P>(body_origin), angular = broadcast<P>(frame.angular);
  Mat3<P> outer_sum = zero33<P>(), by_translation = outer_sum, by_rotation = outer_sum, by_linear = outer_sum,
          by_angular = outer_sum;
  for_contact_points<false, T>(frame, candidates, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    const Vec3<P> r = t.center - origin;
    const SpringForce<P> s = spring_force<derivatives, T>(t, settings.step_length);
    outer_sum += outer(r, s.force);
    if constexpr (derivatives) {
      const Vec3<P> corrected = n * r;
      const Mat3<P> x = cross_columns(corrected, s.by_x);
      by_translation += x;
      by_rotation -= cross_rows(x, r);
      if (!t.law.elastic) return;
      const Mat3<P> v = cross_columns(corrected, s.by_v);
      by_linear += v;
      by_angular -= cross_rows(v, r);
      by_rotation -= cross_rows(v, cross(angular, r));
    }
  });
  sums.outer = sum33<T>(outer_sum);
  if constexpr (derivatives) {
    sums.by_translation = sum33<T>(by_translation);
    sums.by_rotation = sum33<T>(by_rotation);
    sums.by_linear = sum33<T>(by_linear);
    sums.by_angular = sum33<T>(by_angular);
  }
}

// Subtracts h m from w.residual; with derivatives also from w.by_q and w.by_v.
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
    M3<T> by_theta, by_rotation = sums.by_rotation;
    for (int j = 0; j < 3; ++j) {
      by_theta.col(j) = moment_of<T>(arm.by[j] * q);
      by_rotation.col(j) += moment_of<T>(arm.value * skew<T>(V3<T>(V3<T>::Unit(j))) * q);
    }
    by_rotation -= step_length * (by_theta * skew<T>(frame.angular));
    const M3<T> to_body = step_length * rotation.transpose();
    w.by_q.template block<3, 3>(k + 3, k) -= to_body * sums.by_translation * frame.to_world.transpose();
    w.by_q.template block<3, 3>(k + 3, k + 3) -= step_length * skew<T>(moment) + to_body * by_rotation * rotation;
    w.by_v.template block<3, 3>(k + 3, k) -= to_body * sums.by_linear * frame.to_world.transpose();
    w.by_v.template block<3, 3>(k + 3, k + 3) -= to_body * (sums.by_angular + step_length * by_theta) * rotation;
  }
}

}  // namespace gelflow
