// Inverse dynamics of the tree and its derivatives: the part M(q) a + C(q, v) − Jᵀ gravity of the residual.
//
// Per body, at the world's origin:   F_b = I_b A_b + V_b ×* (I_b V_b)
// Force needed at dof k:             r_k = S_k · Σ_{b behind k} F_b                                  (Newton-Euler)
//
// Derivatives. Displacing dof j carries all that is behind it along rigidly, which changes no r_k of a dof k that is
// carried too, except that velocities and accelerations from before j are not carried. With P_j = V_before(j) × S_j,
// what is missing is δV' = P_j and δA' = −S_j × A_before(j) + P_j × (V_b − V_before(j)), so that
//     ∂F_b/∂q_j = S_j ×* F_b + I_b Q_j + B_b P_j,     Q_j = −S_j × A_before(j) − P_j × V_before(j)
//     ∂F_b/∂v_j = I_b (P_j − S_j × V_after(j)) + B_b S_j
//     ∂F_b/∂a_j = I_b S_j
//     B_b X = I_b (X × V_b) + X ×* (I_b V_b) + V_b ×* (I_b X)
// and I, B and F may be summed over subtrees first.
#pragma once

#include "kinematics.hpp"

namespace gelflow {

template <class T>
M6<T> body_inertia(const Body& body, const T* params, const M3<T>& r, const V3<T>& p) {
  const T* n = params + body.mass;
  const T mass = n[0];
  const V3<T> c = p + r * vec3(n + 1);
  M3<T> local;
  local << n[4], n[7], n[8], n[7], n[5], n[9], n[8], n[9], n[6];
  const M3<T> k = skew<T>(c);
  M6<T> inertia;
  const M3<T> turned = r.lazyProduct(local);
  inertia.template topLeftCorner<3, 3>() = turned.lazyProduct(r.transpose());
  inertia.template topLeftCorner<3, 3>() -= mass * cross_columns<T>(c, k);
  inertia.template topRightCorner<3, 3>() = mass * k;
  inertia.template bottomLeftCorner<3, 3>() = -mass * k;
  inertia.template bottomRightCorner<3, 3>() = mass * M3<T>::Identity();
  return inertia;
}

// Adds h · (inverse dynamics) to w.residual; with derivatives also to w.by_q, w.by_v and w.mass (not times h).
template <bool derivatives, class T>
void add_inverse_dynamics(const Model& m, const T* params, const T& h, Workspace<T>& w) {
  const int bodies = static_cast<int>(m.bodies.size());
  for (int i = 0; i < bodies; ++i) {
    const M6<T> inertia = body_inertia<T>(m.bodies[i], params, w.rotation[i], w.position[i]);
    const V6<T> momentum = inertia * w.twist[i];
    w.force[i] = inertia * w.acceleration[i] + cross_force<T>(w.twist[i], momentum);
    if constexpr (derivatives) {
      const M6<T> x = cross_motion_matrix<T>(w.twist[i]);
      w.inertia[i] = inertia;
      M6<T> product;
      product.noalias() = inertia * x;
      w.rate[i] = cross_with_force_matrix<T>(momentum) - product - product.transpose();  // I is symmetric
    }
  }
  for (int i = bodies - 1; i >= 0; --i) {
    const int parent = m.bodies[i].parent;
    if (parent == world) continue;
    w.force[parent] += w.force[i];
    if constexpr (derivatives) {
      w.inertia[parent] += w.inertia[i];
      w.rate[parent] += w.rate[i];
    }
  }
  for (int k = 0; k < m.nv; ++k) w.residual[k] += h * dot6<T>(w.axis[k], w.force[m.dof_body[k]]);
  if constexpr (derivatives) {
    for (int j = 0; j < m.nv; ++j) {
      const V6<T>& s = w.axis[j];
      w.p[j] = cross_motion<T>(w.twist_before[j], s);
      w.q_missing[j] = -cross_motion<T>(s, w.acceleration_before[j]) - cross_motion<T>(w.p[j], w.twist_before[j]);
      w.v_missing[j] = w.p[j] - cross_motion<T>(s, w.twist_after[j]);
    }
    for (int j = 0; j < m.nv; ++j) {
      const int body = m.dof_body[j];
      const V6<T>&s = w.axis[j], &p = w.p[j], &q = w.q_missing[j], &o = w.v_missing[j];
      const V6<T> force_q = w.inertia[body] * q + w.rate[body] * p;
      const V6<T> force_v = w.inertia[body] * o + w.rate[body] * s;
      const V6<T> force_a = w.inertia[body] * s;
      const V6<T> rate_s = w.rate[body].transpose() * s;
      const V6<T> carried = cross_force<T>(s, w.force[body]);
      for (const int k : m.bodies[body].dofs) {  // k before j, or in its group
        if (k > j && m.group_begin[k] != m.group_begin[j]) continue;
        const V6<T>& sk = w.axis[k];
        const bool same = m.group_begin[k] == m.group_begin[j];
        w.by_q(k, j) += h * (dot6<T>(sk, force_q) + (same ? T(0) : dot6<T>(sk, carried)));
        w.by_v(k, j) += h * dot6<T>(sk, force_v);
        w.mass(k, j) = dot6<T>(sk, force_a);
        if (same) continue;
        // The transposed entry: dof j's force when the earlier dof k is displaced; the shared subtree is j's.
        // I is symmetric: Sⱼᵀ I = (I Sⱼ)ᵀ.
        w.by_q(j, k) += h * (dot6<T>(force_a, w.q_missing[k]) + dot6<T>(rate_s, w.p[k]));
        w.by_v(j, k) += h * (dot6<T>(force_a, w.v_missing[k]) + dot6<T>(rate_s, sk));
        w.mass(j, k) = w.mass(k, j);
      }
    }
  }
}

}  // namespace gelflow
