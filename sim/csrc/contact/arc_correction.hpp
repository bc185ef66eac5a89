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
template <class L>
struct Springs {
  Vec3<L> push;
  Mat3<L> by_x, by_v;
};
template <bool derivatives, class T>
GELFLOW_INLINE Springs<Pack<T>> springs(const Touching<T>& t, const T& h) {
  using L = Pack<T>;
  Springs<L> s{-(t.law.kn * t.at.d) * t.at.n, zero33<L>(), zero33<L>()};
  s.by_x.row[2].z = -t.law.kn;  // n = z
  if (!t.law.elastic) return s;
  // −k_s s = k_t v_t + q f_t + (1 − q) f*
  PointForce<L> f;
  point_force<derivatives>(t.law, t.at, t.v, t.e, t.remembers, f);
  const L zero(0.0), q = yielding(t.law, L(h)), rest = L(1.0) - q;
  const auto remembered = [&](const L& x) GELFLOW_LOOP_BODY { return select(t.remembers, x, zero); };
  const Vec3<L> e = t.law.kt * f.slip + q * f.friction + rest * f.wanted;
  s.push.x += remembered(e.x);
  s.push.y += remembered(e.y);
  if constexpr (derivatives) {
    for (int i = 0; i < 2; ++i) {
      Vec3<L> by_x = q * f.by_x.row[i], by_v = q * f.by_v.row[i];
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
V3<T> origin_in(const PairFrame<T>& frame, int body, const Workspace<T>& w) {
  return frame.to_world.transpose() * as<T>(V3<Place<T>>(w.position[body] - frame.origin.template cast<Place<T>>()));
}

// Subtracts h m from w.residual; with derivatives also from w.by_q and w.by_v.
template <bool derivatives, class T>
void subtract_arc_moments(const Model& m, int body, const PairFrame<T>& frame, const NearPoints<T>& near,
                          const TouchRule<T>& rule, Workspace<T>& w) {
  using L = Pack<T>;
  const T& h = rule.h;
  const ArcLever<T> lever(h * frame.angular, derivatives);
  const Mat3<L> n = spread<L>(lever.value);
  const Vec3<L> origin = spread<L>(origin_in<T>(frame, body, w)), spin = spread<L>(frame.angular);
  Mat3<L> spread_sum = zero33<L>(), by_shift = spread_sum, by_turn = by_shift, by_slide = by_shift, by_spin = by_shift;
  for_touching_points<false, T>(frame, near, rule, [&](const Touching<T>& t) GELFLOW_LOOP_BODY {
    const Vec3<L> r = t.center - origin;
    const Springs<L> s = springs<derivatives, T>(t, h);
    spread_sum += outer(r, s.push);
    if constexpr (derivatives) {
      const Vec3<L> arm = n * r;
      const Mat3<L> x = cross_columns(arm, s.by_x);
      by_shift += x;
      by_turn -= cross_rows(x, r);
      if (!t.law.elastic) return;
      const Mat3<L> v = cross_columns(arm, s.by_v);
      by_slide += v;
      by_spin -= cross_rows(v, r);
      by_turn -= cross_rows(v, cross(spin, r));
    }
  });
  const int k = m.joints[m.bodies[body].joint_begin].v;
  const M3<T> q = sum33<T>(spread_sum), rotation = frame.to_world.transpose() * as<T>(w.rotation[body]);
  const V3<T> moment = rotation.transpose() * moment_of<T>(lever.value * q);
  for (int i = 0; i < 3; ++i) w.residual[k + 3 + i] -= h * moment[i];
  if constexpr (derivatives) {
    M3<T> by_theta, turn = sum33<T>(by_turn);
    for (int j = 0; j < 3; ++j) {
      by_theta.col(j) = moment_of<T>(lever.by[j] * q);
      turn.col(j) += moment_of<T>(lever.value * skew<T>(V3<T>(V3<T>::Unit(j))) * q);
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
