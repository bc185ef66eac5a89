// The force of a shape on one point (eq. 8), its derivatives (eqs. 11-16), and the memory of the elastic law.
//
// In the shape's frame, x the point, v its velocity relative to the shape, d, n, H the distance there (d < 0 inside),
// ḋ = n·v, v_t = v − ḋ n:
//     normal      N = max(k_n − k_d ḋ, 0) (−d)          damping scaled by depth (eq. 8, which has no max and can pull)
//                 N = max(−k_n d − r k_d ḋ, 0)          plain damping, for grounds, r = min(−d / 1 µm, 1): switched on
//                                                       at once, a light body that arrives fast would find no solution
//     wanted      f* = −k_t v_t                         viscous friction
//                 f* = −k_s s − k_t v_t                 elastic friction, s = tangential part of e
//     friction    f_t = f* · min(1, µN/‖f*‖)            v_t → 0 lies in the stick branch: no division there
//     force       f = N n + f_t
// e is x − X with the anchor X in the shape's frame; for a rolling point (the lowest point of a sphere, which is not a
// material point) e = X + h v: the anchor then stores the slip itself. A point that just touched has e = 0.
// On slip the anchor moves so that −k_s s = f_t + k_t v_t.
#pragma once

#include "shapes.hpp"

namespace gelflow {

template <class T>
struct PointLaw {
  T kn, kt, mu, kd, ks;  // of this point: already times its weight
  DampingLaw damping;
  bool elastic;
  bool rolling;
  T h;
};

template <class T>
struct PointForce {
  V3<T> force;
  M3<T> by_x, by_v, by_anchor;  // ∂force/∂(x, v, X); the anchor moves the friction alone
  bool slips;
  V3<T> friction, slip;  // f_t, v_t
  M3<T> friction_by_x, friction_by_v, slip_by_x, slip_by_v;
};

template <class T>
GELFLOW_INLINE V3<T> anchor_offset(const PointLaw<T>& law, const V3<T>& x, const V3<T>& v, const V3<T>& anchor,
                                   bool anchored) {
  if (!law.elastic || !anchored) return V3<T>::Zero();
  return law.rolling ? V3<T>(anchor + law.h * v) : V3<T>(x - anchor);
}

// `derivatives`: 0 force only, 1 also by_x and by_v, 2 also by_anchor and the derivatives of friction and slip.
template <int derivatives, class T>
GELFLOW_INLINE void point_force(const PointLaw<T>& law, const Distance<T>& at, const V3<T>& v, const V3<T>& e,
                                bool anchored, PointForce<T>& out) {
  using std::sqrt;
  const V3<T>& n = at.n;
  const T rate = n.dot(v);
  T normal, by_d, by_rate;
  if (law.damping == DampingLaw::depth) {
    const T stiffness = law.kn - law.kd * rate;
    const bool pushes = stiffness > T(0);
    normal = pushes ? -stiffness * at.d : T(0);
    by_d = pushes ? -stiffness : T(0);
    by_rate = pushes ? law.kd * at.d : T(0);
  } else {
    constexpr double ramp = 1e-6;  // [m]
    const bool full = at.d < T(-ramp);
    const T r = full ? T(1) : T(-at.d / T(ramp));
    const T push = -law.kn * at.d - r * law.kd * rate;
    const bool pushes = push > T(0);
    normal = pushes ? push : T(0);
    by_d = pushes ? T((full ? T(0) : T(law.kd * rate / T(ramp))) - law.kn) : T(0);
    by_rate = pushes ? T(-r * law.kd) : T(0);
  }
  const V3<T> slip = v - rate * n;
  V3<T> wanted = -law.kt * slip;
  T along = T(0);
  const bool memory = law.elastic && anchored;
  if (memory) {
    along = n.dot(e);
    wanted -= law.ks * (e - along * n);
  }
  const T bound = law.mu * normal, squared = wanted.squaredNorm();
  out.slips = squared > bound * bound;
  const T length = out.slips ? T(sqrt(squared)) : T(1);
  const T ratio = out.slips ? T(bound / length) : T(1);
  out.friction = wanted * ratio;
  out.slip = slip;
  out.force = normal * n + out.friction;
  if constexpr (derivatives > 0) {
    // d f* = −(k_t + k_s ev) (1 − n nᵀ) dv − k_s ex (1 − n nᵀ) dx + curvature, and
    // d f_t = A d f* + g dN with A = 1, g = 0 (stick) or A = ratio (1 − t tᵀ), g = µ t (slip).
    const T ex = memory && !law.rolling ? T(1) : T(0);
    const T ev = memory && law.rolling ? law.h : T(0);
    const V3<T> direction = out.slips ? V3<T>(wanted / length) : V3<T>(V3<T>::Zero());
    const T mu = out.slips ? law.mu : T(0);
    V3<T> normal_by_x = by_d * n;
    const V3<T> normal_by_v = by_rate * n;
    // A (1 − n nᵀ) = ratio (1 − n nᵀ − t tᵀ), as t is tangential.
    M3<T> project;
    for (int j = 0; j < 3; ++j) {
      for (int i = 0; i < 3; ++i) {
        project(i, j) = ratio * ((i == j ? T(1) : T(0)) - n[i] * n[j] - direction[i] * direction[j]);
      }
    }
    const V3<T> lever = mu * direction;
    M3<T> friction_by_x = (-law.ks * ex) * project;
    M3<T> friction_by_v = (-law.kt - law.ks * ev) * project;
    if (at.curved) {
      const V3<T> hv = at.hessian * v;
      normal_by_x += by_rate * hv;
      M3<T> wanted_by_x = law.kt * (n * hv.transpose() + rate * at.hessian);
      if (memory) wanted_by_x += law.ks * (n * (at.hessian * e).transpose() + along * at.hessian);
      friction_by_x += ratio * (wanted_by_x - direction * (direction.transpose() * wanted_by_x));
      out.by_x = normal * at.hessian;
    } else {
      out.by_x.setZero();
    }
    for (int j = 0; j < 3; ++j) {
      for (int i = 0; i < 3; ++i) {
        friction_by_x(i, j) += lever[i] * normal_by_x[j];
        friction_by_v(i, j) += lever[i] * normal_by_v[j];
        out.by_x(i, j) += friction_by_x(i, j) + n[i] * normal_by_x[j];
        out.by_v(i, j) = friction_by_v(i, j) + n[i] * normal_by_v[j];
      }
    }
    if constexpr (derivatives > 1) {
      const T sign = law.rolling ? T(-1) : T(1);  // ∂f*/∂X = sign k_s (1 − n nᵀ)
      out.by_anchor = memory ? M3<T>((sign * law.ks) * project) : M3<T>(M3<T>::Zero());
      out.friction_by_x = friction_by_x;
      out.friction_by_v = friction_by_v;
      out.slip_by_v = M3<T>::Identity() - n * n.transpose();
      out.slip_by_x = M3<T>::Zero();
      if (at.curved) out.slip_by_x = -(n * (at.hessian * v).transpose() + rate * at.hessian);
    }
  }
}

// The anchor after an accepted step, for a point that is inside (outside, the anchor is cleared).
template <class T>
V3<T> next_anchor(const PointLaw<T>& law, const PointForce<T>& f, const V3<T>& n, const V3<T>& x, const V3<T>& e,
                  const V3<T>& anchor, bool anchored) {
  if (f.slips) {
    const V3<T> s = -(f.friction + law.kt * f.slip) / law.ks;
    return law.rolling ? s : V3<T>(x - s);
  }
  if (law.rolling) return e - n.dot(e) * n;
  return anchored ? anchor : x;
}

// Gradient of the anchor after the step, carried back to (x, v, X); mirrors `next_anchor` branch by branch.
template <class T>
struct AnchorGradient {
  V3<T> x = V3<T>::Zero(), v = V3<T>::Zero(), anchor = V3<T>::Zero();
};
template <class T>
AnchorGradient<T> next_anchor_transposed(const PointLaw<T>& law, const PointForce<T>& f, bool anchored,
                                         const V3<T>& lambda) {
  AnchorGradient<T> g;
  if (f.slips) {
    const V3<T> scaled = (law.rolling ? T(-1) : T(1)) / law.ks * lambda;
    g.x = f.friction_by_x.transpose() * scaled + law.kt * (f.slip_by_x.transpose() * scaled);
    g.v = f.friction_by_v.transpose() * scaled + law.kt * (f.slip_by_v.transpose() * scaled);
    g.anchor = f.by_anchor.transpose() * scaled;
    if (!law.rolling) g.x += lambda;
  } else if (law.rolling) {
    const V3<T> projected = f.slip_by_v * lambda;  // 1 − n nᵀ, symmetric
    if (anchored) {
      g.v = law.h * projected;
      g.anchor = projected;
    }
  } else if (anchored) {
    g.anchor = lambda;
  } else {
    g.x = lambda;
  }
  return g;
}

}  // namespace gelflow
