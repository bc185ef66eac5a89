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
//
// Spring and damper are side by side, and what slips is behind both. After a step of length h that ended in slip, the
// rate w = (s − s_before)/h of the strain satisfies f_t = −k_s s − k_t w, so that friction takes what the point's motion
// brings and the spring does not store. With s_before = s* − h v_t, s* the strain that f* speaks of (so it is under BDF1,
// and under BDF2 but for terms of second order),
//     −k_s s = k_t v_t + q f_t + (1 − q) f*,     q = h k_s / (h k_s + k_t)
// which is −k_s s* in stick, where f_t = f*: there the anchor stays. A point that just touched stores nothing.
#pragma once

#include "geometry/shapes.hpp"

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
  Mat3<L> by_x, by_v;  // ∂force/∂(x, v)
  Mask<L> slips;
  Vec3<L> friction, slip, wanted;  // f_t, v_t, f*
};

// What the force is made of.
template <class L>
struct ForceParts {
  L rate, normal, by_d, by_rate;  // ḋ, N, ∂N/∂d, ∂N/∂ḋ
  L along;                        // n·e
  Vec3<L> slip, wanted;           // v_t, f*
  Mask<L> slips;
  L inverse, ratio;  // 1/‖f*‖ and µN/‖f*‖ where it slips, else 1
};
template <class L>
GELFLOW_INLINE void force_parts(const PointLaw<L>& law, const Distance<L>& at, const Vec3<L>& v, const Vec3<L>& e,
                                ForceParts<L>& p) {
  using std::sqrt;
  const L zero(0.0), one(1.0);
  const Vec3<L>& n = at.n;
  p.rate = dot(n, v);
  if (law.damping == DampingLaw::depth) {
    const L wanted = law.kn - law.kd * p.rate;
    const Mask<L> pushes = wanted > zero;
    const L stiffness = select(pushes, wanted, zero);
    p.normal = -stiffness * at.d;
    p.by_d = -stiffness;
    p.by_rate = select(pushes, law.kd * at.d, zero);
  } else {
    const L ramp(1e-6);  // [m]
    const Mask<L> full = at.d < -ramp;
    const L r = select(full, one, -at.d / ramp);
    const L push = -law.kn * at.d - r * law.kd * p.rate;
    const Mask<L> pushes = push > zero;
    p.normal = select(pushes, push, zero);
    p.by_d = select(pushes, select(full, zero, law.kd * p.rate / ramp) - law.kn, zero);
    p.by_rate = select(pushes, -r * law.kd, zero);
  }
  p.slip = v - p.rate * n;
  p.wanted = -law.kt * p.slip;
  p.along = zero;
  if (law.elastic) {
    p.along = dot(n, e);
    p.wanted -= law.ks * (e - p.along * n);  // e is zero where there is no anchor
  }
  const L bound = law.mu * p.normal, squared = dot(p.wanted, p.wanted);
  // After a slip without k_t the anchor leaves the point exactly on the cone. That counts as stick, rounding or not: the step, its
  // reverse and the readings must not take different sides.
  const L limit = law.elastic ? bound * (one + L(1e-14)) + law.ks * law.rounding : bound;
  p.slips = squared > limit * limit;
  p.inverse = p.ratio = one;
  if (any(p.slips)) {
    p.inverse = one / sqrt(select(p.slips, squared, one));
    p.ratio = select(p.slips, bound * p.inverse, one);
  }
}

template <bool derivatives, class L>
GELFLOW_INLINE void point_force(const PointLaw<L>& law, const Distance<L>& at, const Vec3<L>& v, const Vec3<L>& e,
                                const Mask<L>& anchored, PointForce<L>& out) {
  ForceParts<L> p;
  force_parts(law, at, v, e, p);
  const L zero(0.0);
  const Vec3<L>& n = at.n;
  out.slips = p.slips;
  out.slip = p.slip;
  out.wanted = p.wanted;
  out.friction = p.ratio * p.wanted;
  out.force = p.normal * n + out.friction;
  if constexpr (derivatives) {
    // d f* = −k_t (1 − n nᵀ) dv − k_s (1 − n nᵀ) dx + curvature, the second only where there is an anchor, and
    // d f_t = A d f* + g dN with A = 1, g = 0 (stick) or A = ratio (1 − t tᵀ), g = µ t (slip).
    const L memory = law.elastic ? select(anchored, law.ks, zero) : zero;
    const Vec3<L> direction = select(p.slips, p.inverse, zero) * p.wanted;
    Vec3<L> normal_by_x = p.by_d * n;
    const Vec3<L> lever = n + law.mu * direction;  // what a change of N adds
    // A (1 − n nᵀ) = ratio (1 − n nᵀ − t tᵀ + (t·n) t nᵀ), where t·n = 0 but for a field, whose ‖n‖ is not quite 1.
    Mat3<L> project = p.ratio * (identity_minus_outer(n) - outer(direction, direction));
    if (at.bend == Bend::field) [[unlikely]] {
      project += p.ratio * dot(direction, n) * outer(direction, n);
    }
    out.by_v = -law.kt * project;
    out.by_v += outer(lever, p.by_rate * n);
    if (law.elastic) {
      out.by_x = -memory * project;
    } else {
      out.by_x = zero33<L>();
    }
    if (at.bend != Bend::flat) {
      const Mat3<L> bends = at.curvature();
      const Vec3<L> hv = bends * v;
      normal_by_x += p.by_rate * hv;
      Mat3<L> wanted_by_x = law.kt * (outer(n, hv) + p.rate * bends);
      if (law.elastic) wanted_by_x += memory * (outer(n, bends * e) + p.along * bends);
      out.by_x += p.ratio * (wanted_by_x - outer(direction, transposed_times(wanted_by_x, direction)));
      out.by_x += p.normal * bends;
    }
    out.by_x += outer(lever, normal_by_x);
  }
}

// The reverse: gradients with respect to N n, to f_t, to f* and to v_t, carried back to (x, v, X). The anchor moves the
// friction alone.
template <class L>
struct PointGradient {
  Vec3<L> x, v, anchor;
  Mask<L> slips;
  Vec3<L> force;  // what `point_force` says
};
template <class L>
GELFLOW_INLINE PointGradient<L> point_force_transposed(const PointLaw<L>& law, const Distance<L>& at, const Vec3<L>& v,
                                                       const Vec3<L>& e, const Mask<L>& anchored,
                                                       const Vec3<L>& by_push, const Vec3<L>& by_friction,
                                                       const Vec3<L>& by_wish, const Vec3<L>& by_slip) {
  ForceParts<L> p;
  force_parts(law, at, v, e, p);
  const L zero(0.0);
  const Vec3<L>& n = at.n;
  const Vec3<L> direction = select(p.slips, p.inverse, zero) * p.wanted;
  const L drawn = dot(direction, by_friction);
  const Vec3<L> by_wanted = p.ratio * (by_friction - drawn * direction) + by_wish;
  const L by_normal = dot(n, by_push) + law.mu * drawn;
  // slip = v − ḋ n, wanted = −k_t slip − k_s (e − (n·e) n)
  const Vec3<L> on_slip = by_slip - law.kt * by_wanted;
  const L by_rate = by_normal * p.by_rate - dot(n, on_slip);
  PointGradient<L> g;
  g.slips = p.slips;
  g.force = p.normal * n + p.ratio * p.wanted;
  g.v = on_slip + by_rate * n;
  g.x = by_normal * p.by_d * n;
  g.anchor = zero3<L>();
  L by_along = zero;
  if (law.elastic) {
    const L memory = select(anchored, law.ks, zero);
    by_along = memory * dot(n, by_wanted);
    g.anchor = memory * by_wanted - by_along * n;
    g.x -= g.anchor;
  }
  if (at.bend != Bend::flat) {
    Vec3<L> by_n = p.normal * by_push + by_rate * v - p.rate * on_slip;
    if (law.elastic) by_n += by_along * e + select(anchored, law.ks, zero) * p.along * by_wanted;
    g.x += at.curvature_times(by_n);
  }
  return g;
}

// q, see above.
template <class L>
GELFLOW_INLINE L yielding(const PointLaw<L>& law, const L& h) {
  const L spring = h * law.ks, both = spring + law.kt;
  return spring / select(both > L(0.0), both, L(1.0));
}

// The anchor after an accepted step of length h, for a point that is inside (outside, the anchor is cleared).
template <class L>
GELFLOW_INLINE Vec3<L> next_anchor(const PointLaw<L>& law, const L& h, const PointForce<L>& f, const Vec3<L>& x,
                                   const Vec3<L>& anchor, const Mask<L>& anchored) {
  const L stiffness = select(law.ks > L(0.0), law.ks, L(1.0));  // of weight 0: what comes out is not used
  const L q = yielding(law, h);
  const Vec3<L> s = -(L(1.0) / stiffness) * (law.kt * f.slip + q * f.friction + (L(1.0) - q) * f.wanted);
  return select3<L>(anchored, select3<L>(f.slips, x - s, anchor), x);
}

// Gradient λ of the anchor after the step, carried back to (x, v, X); mirrors `next_anchor` branch by branch.
template <class L>
GELFLOW_INLINE PointGradient<L> next_anchor_transposed(const PointLaw<L>& law, const L& h, const Distance<L>& at,
                                                       const Vec3<L>& v, const Vec3<L>& e, const Mask<L>& anchored,
                                                       const Vec3<L>& lambda) {
  const L zero(0.0), one(1.0), stiffness = select(law.ks > zero, law.ks, one), q = yielding(law, h);
  const Vec3<L> none = zero3<L>(), scaled = one / stiffness * lambda;
  PointGradient<L> g =
      point_force_transposed(law, at, v, e, anchored, none, q * scaled, (one - q) * scaled, law.kt * scaled);
  const Mask<L> yields = g.slips && anchored;
  g.x = select3<L>(yields, g.x + lambda, select3<L>(anchored, none, lambda));
  g.v = select3<L>(yields, g.v, none);
  g.anchor = select3<L>(yields, g.anchor, select3<L>(anchored, lambda, none));
  return g;
}

}  // namespace gelflow
