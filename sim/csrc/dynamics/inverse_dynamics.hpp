// Inverse dynamics of the kinematic tree and its derivatives: the part M(q) a + C(q, v) − Jᵀ gravity of the residual.
//
// Per body, at the world's origin:   F_b = I_b A_b + V_b ×* (I_b V_b)
// Force at dof k:                    r_k = S_k · Σ_{b in the subtree of k} F_b                       (Newton-Euler)
//
// Derivatives. A displacement of dof j moves its subtree rigidly. That changes no r_k of a dof k in the subtree, except
// that the velocities and accelerations before j do not move along. With P_j = V_before(j) × S_j, the difference to the
// rigid motion is δV' = P_j and δA' = −S_j × A_before(j) + P_j × (V_b − V_before(j)), so that
//     ∂F_b/∂q_j = S_j ×* F_b + I_b Q_j + B_b P_j,     Q_j = −S_j × A_before(j) − P_j × V_before(j)
//     ∂F_b/∂v_j = I_b (P_j − S_j × V_after(j)) + B_b S_j
//     ∂F_b/∂a_j = I_b S_j
//     B_b X = I_b (X × V_b) + X ×* (I_b V_b) + V_b ×* (I_b X)
// and I, B and F are summed over subtrees first. With mass m, moment m c, rotational inertia J about the world's
// origin, V = (ω, v), p = m v + ω × m c and X = (x, y), a translation y changes no B X, and
//     I X = (J x + m c × y, m y − m c × x),     B X = (B₁ x, −2 p × x),     B₁ = [ω]× (2 J − tr J) + 2 ((m c · v) − v m cᵀ)
// (Jacobi's identity, and J (a × b) + J a × b + a × J b = tr J a × b). For a slide without a rotation before it P, Q and
// B S vanish, and only the mass is needed (`Model::translation_only`).
#pragma once

#include "dynamics/free_body.hpp"

namespace gelflow {

template <class T>
GELFLOW_INLINE V6<T> times_inertia(const Composite<T>& c, const V6<T>& x) {
  const V3<T> w = top(x), v = bottom(x);
  return stack<T>(c.inertia * w + cross<T>(c.moment, v), c.mass * v - cross<T>(c.moment, w));
}
template <class T>
GELFLOW_INLINE V6<T> times_rate(const Composite<T>& c, const V6<T>& x) {
  const V3<T> w = top(x);
  return stack<T>(c.rate * w, T(-2) * cross<T>(c.momentum, w));
}
// The angular part of Bᵀ X; the linear part is zero.
template <class T>
GELFLOW_INLINE V3<T> transposed_rate_times(const Composite<T>& c, const V6<T>& x) {
  return c.rate.transpose() * top(x) + T(2) * cross<T>(c.momentum, bottom(x));
}

// The force F_b of one body and its inertia `c`; c.rate and c.momentum are set with derivatives only.
template <bool derivatives, class T>
GELFLOW_INLINE V6<T> body_force(const Body& body, const T* params, const M3<T>& r, const V3<T>& p, const V6<T>& twist,
                                const V6<T>& acceleration, Composite<T>& c) {
  const BodyParams<T>& own = body.params.in(params);
  c.mass = own.mass;
  if (body.translation_only) return stack<T>(V3<T>::Zero(), c.mass * bottom(acceleration));
  const V3<T> w = top(twist), v = bottom(twist), center = p + r * own.com;
  const M3<T> turned = r.lazyProduct(own.inertia());
  c.moment = c.mass * center;
  c.inertia = turned.lazyProduct(r.transpose());
  c.inertia -= c.moment * center.transpose();
  const T squared = c.moment.dot(center);
  for (int i = 0; i < 3; ++i) c.inertia(i, i) += squared;
  const V3<T> momentum = c.mass * v + cross<T>(w, c.moment);
  const V3<T> angular_momentum = c.inertia * w + cross<T>(c.moment, v);
  if constexpr (derivatives) {
    c.momentum = momentum;
    M3<T> spread = T(2) * c.inertia;
    const T trace = c.inertia.trace();
    for (int i = 0; i < 3; ++i) spread(i, i) -= trace;
    c.rate = cross_columns<T>(w, spread);
    c.rate -= V3<T>(T(2) * v) * c.moment.transpose();
    const T along = T(2) * c.moment.dot(v);
    for (int i = 0; i < 3; ++i) c.rate(i, i) += along;
  }
  const V6<T> inertial = times_inertia<T>(c, acceleration);
  return stack<T>(top(inertial) + cross<T>(w, angular_momentum) + cross<T>(v, momentum),
                  bottom(inertial) + cross<T>(w, momentum));
}

// Sums forces, and with derivatives inertias, over subtrees.
template <bool derivatives, class T>
GELFLOW_INLINE void sum_subtrees(const Model& m, Workspace<T>& w) {
  for (int i = static_cast<int>(m.bodies.size()) - 1; i >= 0; --i) {
    const int parent = m.bodies[i].parent;
    if (parent == world) continue;
    w.force[parent] += w.force[i];
    if constexpr (derivatives) {
      Composite<T>& sum = w.composite[parent];
      const Composite<T>& own = w.composite[i];
      sum.mass += own.mass;
      if (m.bodies[parent].translation_only) continue;
      sum.moment += own.moment;
      sum.inertia += own.inertia;
      sum.rate += own.rate;
      sum.momentum += own.momentum;
    }
  }
}

// Mass matrix entries of a dof that is a translation without a rotation before it.
template <class T>
GELFLOW_INLINE void set_translation_mass(const Model& m, int j, Workspace<T>& w) {
  const int body = m.dof_body[j];
  const V6<T> s = w.axis[j];
  const V3<T> momentum = w.composite[body].mass * bottom(s);
  for (const int k : m.bodies[body].dofs) {
    if (k > j) continue;
    w.mass.in_tree(k, j) = w.mass.in_tree(j, k) = bottom(w.axis[k]).dot(momentum);
  }
}

// P_j, Q_j and P_j − S_j × V_after(j).
template <class T>
GELFLOW_INLINE void set_motion_derivatives(int j, Workspace<T>& w) {
  const V6<T> s = w.axis[j], before = w.twist_before[j];
  const V6<T> p = cross_motion<T>(before, s);
  const V6<T> q = -cross_motion<T>(s, w.acceleration_before[j]) - cross_motion<T>(p, before);
  const V6<T> o = p - cross_motion<T>(s, w.twist_after[j]);
  w.p[j] = p;
  w.dmotion_dq[j] = q;
  w.dmotion_dv[j] = o;
}

// Rows and columns of the mass matrix and of the derivatives that dof j shares with its ancestors and its group.
template <class T>
GELFLOW_INLINE void add_dof_derivatives(const Model& m, const T& beta_h, int j, Workspace<T>& w) {
  const int body = m.dof_body[j];
  const Composite<T>& composite = w.composite[body];
  const V6<T> s = w.axis[j];
  const V6<T> force_q = times_inertia<T>(composite, w.dmotion_dq[j]) + times_rate<T>(composite, w.p[j]);
  const V6<T> force_v = times_inertia<T>(composite, w.dmotion_dv[j]) + times_rate<T>(composite, s);
  const V6<T> force_a = times_inertia<T>(composite, s);
  const V3<T> rate_s = transposed_rate_times<T>(composite, s);
  const V6<T> moved_force_q = force_q + cross_force<T>(s, w.force[body]);
  for (const int k : m.bodies[body].dofs) {
    if (k > j && m.group_begin[k] != m.group_begin[j]) continue;
    const V6<T> sk = w.axis[k];
    const bool same_group = m.group_begin[k] == m.group_begin[j];
    w.dg_dq.in_tree(k, j) += beta_h * dot6<T>(sk, same_group ? force_q : moved_force_q);
    w.dg_dv.in_tree(k, j) += beta_h * dot6<T>(sk, force_v);
    w.mass.in_tree(k, j) = dot6<T>(sk, force_a);
    if (same_group) continue;
    w.mass.in_tree(j, k) = w.mass.in_tree(k, j);
    if (m.translation_only[k]) continue;
    // The transposed entry, the force at dof j by the ancestor k, sums over the subtree of j. I is symmetric:
    // Sⱼᵀ I = (I Sⱼ)ᵀ.
    w.dg_dq.in_tree(j, k) += beta_h * (dot6<T>(force_a, w.dmotion_dq[k]) + rate_s.dot(top(w.p[k])));
    w.dg_dv.in_tree(j, k) += beta_h * (dot6<T>(force_a, w.dmotion_dv[k]) + rate_s.dot(top(sk)));
  }
}

// Adds β h · (inverse dynamics) to w.residual; with derivatives also to w.dg_dq and w.dg_dv, and sets w.mass (without
// the factor β h). `start` is the start of the step; null: w.q and w.generalized_acceleration alone define the state
// and the accelerations, and of the derivatives of free bodies only w.mass is set.
template <bool derivatives, class T>
void add_inverse_dynamics(const Model& m, const T* params, const T& beta_h, const T* v, const StepStart<T>* start,
                          Workspace<T>& w) {
  for (std::size_t i = 0, bodies = m.bodies.size(); i < bodies; ++i) {
    if (m.bodies[i].is_free) {
      add_free_body<derivatives, T>(m, m.bodies[i], params, beta_h, v, start, w);
      continue;
    }
    w.force[i] = body_force<derivatives, T>(m.bodies[i], params, as<T>(w.rotation[i]), as<T>(w.position[i]), w.twist[i],
                                            w.acceleration[i], w.composite[i]);
  }
  sum_subtrees<derivatives, T>(m, w);
  for (const int k : m.articulated_dofs) w.residual[k] += beta_h * dot6<T>(w.axis[k], w.force[m.dof_body[k]]);
  if constexpr (!derivatives) return;
  for (const int j : m.articulated_dofs) {
    if (m.translation_only[j]) {
      set_translation_mass<T>(m, j, w);
    } else {
      set_motion_derivatives<T>(j, w);
    }
  }
  for (const int j : m.articulated_dofs) {
    if (!m.translation_only[j]) add_dof_derivatives<T>(m, beta_h, j, w);
  }
}

}  // namespace gelflow
