// The force of a shape on one point (eq. 8), its derivatives (eqs. 11-16), and the memory of the elastic law.
//
// In the shape's frame, x the point, v its velocity relative to the shape, d, n, H the distance there (d < 0 inside),
// ḋ = n·v, v_t = v − ḋ n:
//     normal      N = max(k_n − k_d ḋ, 0) (−d)          damping scaled by depth (eq. 8, which has no max and can pull)
//                 N = max(−k_n d − r k_d ḋ, 0)          plain damping, for grounds, r = min(−d / 1 µm, 1): switched on
//                                                       at once, a light body that arrives fast would find no solution
//     wanted      f* = −k_t v_t                         viscous friction
//                 f* = −k_s s − k_t v_t                 elastic friction, s = tangential part of e
//     friction    f_t = f* · min(1, µN/‖f*‖)            v_t → 0 lies in the stick branch: no division there; under the
//                                                       elastic law with a slack of rounding size, see below
//     force       f = N n + f_t
// Under the elastic law e = x − X with the anchor X in the shape's frame; a point that just touched has e = 0. The one
// moving point of a sphere on a plane is not a material point and has no anchor: it follows the viscous law.
// On slip the anchor moves so that −k_s s = f_t + k_t v_t.
#pragma once

#include "shapes.hpp"

namespace gelflow {

// Everything is written for a lane type L: some points at once (lanes.hpp). A point of weight 0 feels nothing.
template <class L>
struct PointLaw {
  L kn, kt, mu, kd, ks;  // of these points: already times their weights
  L rounding;            // of places [m]
  DampingLaw damping;
  bool elastic;
};

template <class L>
struct PointForce {
  Vec3<L> force;
  Mat3<L> by_x, by_v, by_anchor;  // ∂force/∂(x, v, X); the anchor moves the friction alone
  Mask<L> slips;
  Vec3<L> friction, slip;  // f_t, v_t
  Mat3<L> friction_by_x, friction_by_v, slip_by_x, slip_by_v;
};

// `derivatives`: 0 force only, 1 also by_x and by_v, 2 also by_anchor and the derivatives of friction and slip.
template <int derivatives, class L>
GELFLOW_INLINE void point_force(const PointLaw<L>& law, const Distance<L>& at, const Vec3<L>& v, const Vec3<L>& e,
                                const Mask<L>& anchored, PointForce<L>& out) {
  using std::sqrt;
  const L zero(0.0), one(1.0);
  const Vec3<L>& n = at.n;
  const L rate = dot(n, v);
  L normal, by_d, by_rate;
  if (law.damping == DampingLaw::depth) {
    const L wanted = law.kn - law.kd * rate;
    const Mask<L> pushes = wanted > zero;
    const L stiffness = select(pushes, wanted, zero);
    normal = -stiffness * at.d;
    by_d = -stiffness;
    by_rate = select(pushes, law.kd * at.d, zero);
  } else {
    const L ramp(1e-6);  // [m]
    const Mask<L> full = at.d < -ramp;
    const L r = select(full, one, -at.d / ramp);
    const L push = -law.kn * at.d - r * law.kd * rate;
    const Mask<L> pushes = push > zero;
    normal = select(pushes, push, zero);
    by_d = select(pushes, select(full, zero, law.kd * rate / ramp) - law.kn, zero);
    by_rate = select(pushes, -r * law.kd, zero);
  }
  const Vec3<L> slip = v - rate * n;
  Vec3<L> wanted = -law.kt * slip;
  L along = zero;
  if (law.elastic) {
    along = dot(n, e);
    wanted -= law.ks * (e - along * n);  // e is zero where there is no anchor
  }
  const L bound = law.mu * normal, squared = dot(wanted, wanted);
  // After a slip the anchor leaves the point exactly on the cone. That counts as stick, rounding or not: the step, its
  // reverse and the readings must not take different sides.
  const L limit = law.elastic ? bound * (one + L(1e-14)) + law.ks * law.rounding : bound;
  out.slips = squared > limit * limit;
  const L inverse = one / sqrt(select(out.slips, squared, one));
  const L ratio = select(out.slips, bound * inverse, one);
  out.friction = ratio * wanted;
  out.slip = slip;
  out.force = normal * n + out.friction;
  if constexpr (derivatives > 0) {
    // d f* = −k_t (1 − n nᵀ) dv − k_s (1 − n nᵀ) dx + curvature, the second only where there is an anchor, and
    // d f_t = A d f* + g dN with A = 1, g = 0 (stick) or A = ratio (1 − t tᵀ), g = µ t (slip).
    const L memory = law.elastic ? select(anchored, law.ks, zero) : zero;
    const Vec3<L> direction = select(out.slips, inverse, zero) * wanted;
    Vec3<L> normal_by_x = by_d * n;
    const Vec3<L> normal_by_v = by_rate * n;
    // A (1 − n nᵀ) = ratio (1 − n nᵀ − t tᵀ + (t·n) t nᵀ), where t·n = 0 but for a field, whose ‖n‖ is not quite 1.
    Mat3<L> project = ratio * (identity_minus_outer(n) - outer(direction, direction));
    const Vec3<L> lever = law.mu * direction;
    out.friction_by_v = -law.kt * project + outer(lever, normal_by_v);
    out.friction_by_x = law.elastic ? -memory * project : zero33<L>();
    if (at.bend != Bend::flat) {
      if (at.bend == Bend::field) [[unlikely]] {
        const Mat3<L> lean = ratio * dot(direction, n) * outer(direction, n);
        project += lean;
        out.friction_by_v -= law.kt * lean;
        if (law.elastic) out.friction_by_x -= memory * lean;
      }
      const Vec3<L> hv = at.hessian * v;
      normal_by_x += by_rate * hv;
      Mat3<L> wanted_by_x = law.kt * (outer(n, hv) + rate * at.hessian);
      if (law.elastic) wanted_by_x += memory * (outer(n, at.hessian * e) + along * at.hessian);
      out.friction_by_x += ratio * (wanted_by_x - outer(direction, transposed_times(wanted_by_x, direction)));
    }
    out.friction_by_x += outer(lever, normal_by_x);
    out.by_x = out.friction_by_x + outer(n, normal_by_x);
    if (at.bend != Bend::flat) out.by_x += normal * at.hessian;
    out.by_v = out.friction_by_v + outer(n, normal_by_v);
    if constexpr (derivatives > 1) {
      out.by_anchor = memory * project;  // ∂f*/∂X = k_s (1 − n nᵀ)
      out.slip_by_v = identity_minus_outer(n);
      out.slip_by_x = zero33<L>();
      if (at.bend != Bend::flat) out.slip_by_x -= outer(n, at.hessian * v) + rate * at.hessian;
    }
  }
}

// The anchor after an accepted step, for a point that is inside (outside, the anchor is cleared).
template <class L>
GELFLOW_INLINE Vec3<L> next_anchor(const PointLaw<L>& law, const PointForce<L>& f, const Vec3<L>& x,
                                   const Vec3<L>& anchor, const Mask<L>& anchored) {
  const L stiffness = select(law.ks > L(0.0), law.ks, L(1.0));  // of weight 0: what comes out is not used
  const Vec3<L> s = -(L(1.0) / stiffness) * (f.friction + law.kt * f.slip);
  return select3<L>(f.slips, x - s, select3<L>(anchored, anchor, x));
}

// Gradient of the anchor after the step, carried back to (x, v, X); mirrors `next_anchor` branch by branch.
template <class L>
struct AnchorGradient {
  Vec3<L> x, v, anchor;
};
template <class L>
GELFLOW_INLINE AnchorGradient<L> next_anchor_transposed(const PointLaw<L>& law, const PointForce<L>& f,
                                                        const Mask<L>& anchored, const Vec3<L>& lambda) {
  const L zero(0.0), one(1.0), stiffness = select(law.ks > zero, law.ks, one);
  const Vec3<L> none = zero3<L>();
  const Vec3<L> scaled = one / stiffness * lambda;
  AnchorGradient<L> g;
  g.x = transposed_times(f.friction_by_x, scaled) + law.kt * transposed_times(f.slip_by_x, scaled);
  g.v = transposed_times(f.friction_by_v, scaled) + law.kt * transposed_times(f.slip_by_v, scaled);
  g.anchor = transposed_times(f.by_anchor, scaled);
  g.x = select3<L>(f.slips, g.x + lambda, select3<L>(anchored, none, lambda));
  g.v = select3<L>(f.slips, g.v, none);
  g.anchor = select3<L>(f.slips, g.anchor, select3<L>(anchored, lambda, none));
  return g;
}

}  // namespace gelflow
