// Under BDF1: what springs between a free body and a plane of the world do along the way that the body's points take.
//
// Over a step the body's origin moves by h v and the body turns by θ = h ω, so that a point at r from the origin (world
// axes, at the step's end) moves along an arc,
//     x − x_before = h v + θ × B r,     B = ∫₀¹ exp(−s [θ]×) ds = Jr(θ)
// and not by h (v + ω × r). Where a spring's force p takes the moment r × p, its work is that of the second, while what it
// stores is that of the first: a body that turns fast gains energy. With the moment (B r) × p its work in the step is
// p · (x − x_before), which is at least what it stores less, so that BDF1 never adds energy. What damping and friction
// take they take along h (v + ω × r), by the moment r × f as ever. So the springs alone add
//     m = Σ (N r) × p,     N = B − 1,     p = −k_n d n − k_s s
// with s as it is after the step (contact_law.hpp). For a sphere's moving point r is that of its centre.
//
// Derivatives. In the shape's frame, with a displacement (φ, δ) of the body and (ω', v') of its velocities there, the
// turning of the body's frame included, u = ω × r, N_j = ∂N/∂θ_j, Q = Σ r pᵀ and a(M) = Σ_ij M_ij e_i × e_j:
//     dr = φ × r,   dx = δ + dr,   dv = v' + ω' × r + φ × u,   dθ = h (φ × ω + ω')
//     dm = Σ_j a(N_j Q) dθ_j + a(N [φ]× Q) + Σ [N r]× (∂p/∂x dx + ∂p/∂v dv)
#pragma once

#include "contact/arc_moment_arm.hpp"
#include "contact/contact_points.hpp"

namespace gelflow {

// a(M): the moment of Σ r pᵀ = M.
template <class T>
V3<T> moment_of(const M3<T>& m) {
  return {m(1, 2) - m(2, 1), m(2, 0) - m(0, 2), m(0, 1) - m(1, 0)};
}

// The springs of one point: p, ∂p/∂x, ∂p/∂v.
template <class P>
struct SpringForce {
  Vec3<P> push;
  Mat3<P> by_x, by_v;
};
template <bool derivatives, class T>
GELFLOW_INLINE SpringForce<Pack<T>> spring_force(const ContactPack<T>& t, const T& h) {
  using P = Pack<T>;
  SpringForce<P> s{-(t.law.kn * t.at.d) * t.at.n, zero33<P>(), zero33<P>()};
  s.by_x.row[2].z = -t.law.kn;  // n = z
  if (!t.law.elastic) return s;
  // −k_s s = k_t v_t + q f_t + (1 − q) f*
  PointForce<P> f;
  point_force<derivatives>(t.law, t.at, t.v, t.e, t.has_anchor, f);
  const P zero(0.0), q = relaxation_factor(t.law, P(h)), rest = P(1.0) - q;
  const auto remembered = [&](const P& x) GELFLOW_LOOP_BODY { return select(t.has_anchor, x, zero); };
  const Vec3<P> e = t.law.kt * f.slip_velocity + q * f.friction + rest * f.trial;
  s.push.x += remembered(e.x);
  s.push.y += remembered(e.y);
  if constexpr (derivatives) {
    for (int i = 0; i < 2; ++i) {
      Vec3<P> by_x = q * f.by_x.row[i], by_v = q * f.by_v.row[i];
      (i == 0 ? by_x.x : by_x.y) -= rest * t.law.ks;
      (i == 0 ? by_v.x : by_v.y) += q * t.law.kt;
      s.by_x.row[i] = {remembered(by_x.x), remembered(by_x.y), remembered(by_x.z)};
      s.by_v.row[i] = {remembered(by_v.x), remembered(by_v.y), remembered(by_v.z)};
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

// Where the body's origin is in the shape's frame.
template <class T>
V3<T> body_origin_in_shape(const PairFrame<T>& frame, int body, const Workspace<T>& w) {
  return frame.to_world.transpose() *
         as<T>(V3<PositionScalar<T>>(w.position[body] - frame.origin.template cast<PositionScalar<T>>()));
}

// Subtracts h m from w.residual; with derivatives also from w.by_q and w.by_v.
template <bool derivatives, class T>
void subtract_arc_correction(const Model& m, int body, const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                             const ContactSettings<T>& settings, Workspace<T>& w) {
  using P = Pack<T>;
  const T& h = settings.h;
  const MomentArmCorrection<T> arm(h * frame.angular, derivatives);
  const Mat3<P> n = broadcast<P>(arm.value);
  const Vec3<P> origin = broadcast<P>(body_origin_in_shape<T>(frame, body, w)), spin = broadcast<P>(frame.angular);
  Mat3<P> outer_sum = zero33<P>(), by_shift = outer_sum, by_turn = by_shift, by_slide = by_shift, by_spin = by_shift;
  for_contact_points<false, T>(frame, candidates, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    const Vec3<P> r = t.center - origin;
    const SpringForce<P> s = spring_force<derivatives, T>(t, h);
    outer_sum += outer(r, s.push);
    if constexpr (derivatives) {
      const Vec3<P> arm = n * r;
      const Mat3<P> x = cross_columns(arm, s.by_x);
      by_shift += x;
      by_turn -= cross_rows(x, r);
      if (!t.law.elastic) return;
      const Mat3<P> v = cross_columns(arm, s.by_v);
      by_slide += v;
      by_spin -= cross_rows(v, r);
      by_turn -= cross_rows(v, cross(spin, r));
    }
  });
  const int k = m.joints[m.bodies[body].joint_begin].v;
  const M3<T> q = sum33<T>(outer_sum), rotation = frame.to_world.transpose() * as<T>(w.rotation[body]);
  const V3<T> moment = rotation.transpose() * moment_of<T>(arm.value * q);
  for (int i = 0; i < 3; ++i) w.residual[k + 3 + i] -= h * moment[i];
  if constexpr (derivatives) {
    M3<T> by_theta, turn = sum33<T>(by_turn);
    for (int j = 0; j < 3; ++j) {
      by_theta.col(j) = moment_of<T>(arm.by[j] * q);
      turn.col(j) += moment_of<T>(arm.value * skew<T>(V3<T>(V3<T>::Unit(j))) * q);
    }
    turn -= h * (by_theta * skew<T>(frame.angular));
    const M3<T> back = h * rotation.transpose();
    w.by_q.template block<3, 3>(k + 3, k) -= back * sum33<T>(by_shift) * frame.to_world.transpose();
    w.by_q.template block<3, 3>(k + 3, k + 3) -= h * skew<T>(moment) + back * turn * rotation;
    w.by_v.template block<3, 3>(k + 3, k) -= back * sum33<T>(by_slide) * frame.to_world.transpose();
    w.by_v.template block<3, 3>(k + 3, k + 3) -= back * (sum33<T>(by_spin) + h * by_theta) * rotation;
  }
}

}  // namespace gelflow
