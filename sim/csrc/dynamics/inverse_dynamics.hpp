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
// and I, B and F may be summed over subtrees first. With mass m, moment m c, rotational inertia J about the world's
// origin, V = (ω, v), p = m v + ω × m c and X = (x, y), a translation y changes no B X, and
//     I X = (J x + m c × y, m y − m c × x),     B X = (B₁ x, −2 p × x),     B₁ = [ω]× (2 J − tr J) + 2 ((m c · v) − v m cᵀ)
// (Jacobi's identity, and J (a × b) + J a × b + a × J b = tr J a × b). Where nothing before a slide turns, and it is no
// hinge, P, Q and its share of B vanish: mass is all that counts (`Model::translates`).
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
// Bᵀ X, of which the linear part is zero.
template <class T>
GELFLOW_INLINE V3<T> transposed_rate_times(const Composite<T>& c, const V6<T>& x) {
  return c.rate.transpose() * top(x) + T(2) * cross<T>(c.momentum, bottom(x));
}

// The force F_b that moves one body as it does, and its composite, of which `rate` and `momentum` only with derivatives.
template <bool derivatives, class T>
GELFLOW_INLINE V6<T> body_force(const Body& body, const T* params, const M3<T>& r, const V3<T>& p, const V6<T>& twist,
                                const V6<T>& acceleration, Composite<T>& c) {
  const T* n = params + body.mass;
  c.mass = n[0];
  if (body.translation_only) return stack<T>(V3<T>::Zero(), c.mass * bottom(acceleration));
  const V3<T> w = top(twist), v = bottom(twist), center = p + r * vec3(n + 1);
  M3<T> local;
  local << n[4], n[7], n[8], n[7], n[5], n[9], n[8], n[9], n[6];
  const M3<T> turned = r.lazyProduct(local);
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

// Adds h · (inverse dynamics) to w.residual; with derivatives also to w.by_q and w.by_v, and sets w.mass (not times h).
// `from`: where the step started; null: the state (q, v) and accelerations alone, and only w.mass of all derivatives.
template <bool derivatives, class T>
void add_inverse_dynamics(const Model& m, const T* params, const T& h, const T* v, const StepStart<T>* from,
                          Workspace<T>& w) {
  const int bodies = static_cast<int>(m.bodies.size());
  for (int i = 0; i < bodies; ++i) {
    if (m.bodies[i].is_free) {
      add_free_body<derivatives, T>(m, m.bodies[i], params, h, v, from, w);
      continue;
    }
    w.force[i] = body_force<derivatives, T>(m.bodies[i], params, as<T>(w.rotation[i]), as<T>(w.position[i]), w.twist[i],
                                            w.acceleration[i], w.composite[i]);
  }
  for (int i = bodies - 1; i >= 0; --i) {
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
  for (const int k : m.articulated_dofs) w.residual[k] += h * dot6<T>(w.axis[k], w.force[m.dof_body[k]]);
  if constexpr (!derivatives) return;
  for (const int j : m.articulated_dofs) {
    const V6<T> s = w.axis[j];
    const int body = m.dof_body[j];
    const Composite<T>& composite = w.composite[body];
    if (m.translation_only[j]) {
      const V3<T> momentum = composite.mass * bottom(s);
      for (const int k : m.bodies[body].dofs) {
        if (k > j) continue;
        w.mass(k, j) = w.mass(j, k) = bottom(w.axis[k]).dot(momentum);
      }
      continue;
    }
    const V6<T> before = w.twist_before[j];
    const V6<T> p = cross_motion<T>(before, s);
    const V6<T> q = -cross_motion<T>(s, w.acceleration_before[j]) - cross_motion<T>(p, before);
    const V6<T> o = p - cross_motion<T>(s, w.twist_after[j]);
    w.p[j] = p;
    w.q_missing[j] = q;
    w.v_missing[j] = o;
  }
  for (const int j : m.articulated_dofs) {
    if (m.translation_only[j]) continue;
    const int body = m.dof_body[j];
    const Composite<T>& composite = w.composite[body];
    const V6<T> s = w.axis[j];
    const V6<T> force_q = times_inertia<T>(composite, w.q_missing[j]) + times_rate<T>(composite, w.p[j]);
    const V6<T> force_v = times_inertia<T>(composite, w.v_missing[j]) + times_rate<T>(composite, s);
    const V6<T> force_a = times_inertia<T>(composite, s);
    const V3<T> rate_s = transposed_rate_times<T>(composite, s);
    const V6<T> carried = force_q + cross_force<T>(s, w.force[body]);
    for (const int k : m.bodies[body].dofs) {  // k before j, or in its group
      if (k > j && m.group_begin[k] != m.group_begin[j]) continue;
      const V6<T> sk = w.axis[k];
      const bool same = m.group_begin[k] == m.group_begin[j];
      w.by_q(k, j) += h * dot6<T>(sk, same ? force_q : carried);
      w.by_v(k, j) += h * dot6<T>(sk, force_v);
      w.mass(k, j) = dot6<T>(sk, force_a);
      if (same) continue;
      w.mass(j, k) = w.mass(k, j);
      if (m.translation_only[k]) continue;
      // The transposed entry: dof j's force when the earlier dof k is displaced; the shared subtree is j's.
      // I is symmetric: Sⱼᵀ I = (I Sⱼ)ᵀ.
      w.by_q(j, k) += h * (dot6<T>(force_a, w.q_missing[k]) + rate_s.dot(top(w.p[k])));
      w.by_v(j, k) += h * (dot6<T>(force_a, w.v_missing[k]) + rate_s.dot(top(sk)));
    }
  }
}

}  // namespace gelflow
