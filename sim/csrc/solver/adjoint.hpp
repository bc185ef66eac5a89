// The reverse pass of one step (eqs. 19-23).
//
// Equation numbers are those of the appendix of Xu et al., "Efficient Tactile Simulation with Differentiability for
// Robotic Manipulation", CoRL 2022.
//
// The position increment of this step is β h v_t + γ δ. With b the gradient with respect to v_t, directly and through
// the increment, A = ∂g/∂v_t at the accepted state, and c the multiplier of the residual g:
//     Aᵀ c = b,   ∂L/∂u −= cᵀ ∂g/∂u,   ∂L/∂v* = Mᵀ c,
//     ∂L/∂q_{t-1} = (∂q_t/∂q_{t-1})ᵀ (∂L/∂q_t − (∂g/∂q_t)ᵀ c),   ∂L/∂X_{t-1} −= cᵀ ∂g/∂X_{t-1}.
// The anchors after the step depend on the state at its end: their gradient is added to ∂L/∂q_t and ∂L/∂v_t first. Under
// BDF2 the position increment of this step is δ of the next step, and v_{t-1} its v_{t-2}.
#pragma once

#include "solver/step.hpp"

namespace gelflow {

// Gradient with respect to a state; that of q is a tangent vector.
template <class T>
struct StateGradient {
  explicit StateGradient(const Model& m)
      : q(VX<T>::Zero(m.nv)), v(VX<T>::Zero(m.nv)), history(VX<T>::Zero(m.nh)), anchors(m.na, V3<T>::Zero()) {}
  VX<T> q, v, history;
  std::vector<V3<T>> anchors;
};

// Data of one accepted substep for the reverse pass.
template <class T>
struct SubstepRecord {
  SubstepRecord(const Model& m, const StepStart<T>& start, const VX<T>& v_new, bool full_step)
      : beta_h(start.beta_h),
        bdf2(start.history != nullptr),
        full_step(full_step),
        q0(Eigen::Map<const VX<T>>(start.q0, m.nq)),
        v_star(Eigen::Map<const VX<T>>(start.v_star, m.nv)),
        v1(v_new),
        anchors(start.anchors, start.anchors + m.na),
        anchored(start.anchored, start.anchored + m.na) {
    if (bdf2) history = Eigen::Map<const VX<T>>(start.history, 2 * m.nv);
  }
  StepStart<T> start(const T* u) const {
    return {beta_h,          q0.data(), v_star.data(), nullptr, bdf2 ? history.data() : nullptr, anchors.data(),
            anchored.data(), u};
  }
  T beta_h;        // β h
  bool bdf2;       // the step used BDF2
  bool full_step;  // not a part of a divided step: it is the history of a next step by BDF2
  VX<T> q0, v_star, history, v1;
  std::vector<V3<T>> anchors;
  std::vector<std::uint8_t> anchored;
};

// A state with its own memory.
template <class T>
struct StateCopy {
  StateCopy(const Model& m, const StateView<T>& s)
      : q(s.q, s.q + m.nq),
        v(s.v, s.v + m.nv),
        history(s.history, s.history + m.nh),
        anchors(s.anchors, s.anchors + m.na),
        anchored(s.anchored, s.anchored + m.na) {}
  StateView<T> view() { return {q.data(), v.data(), anchors.data(), anchored.data(), history.data()}; }
  std::vector<T> q, v, history;
  std::vector<V3<T>> anchors;
  std::vector<std::uint8_t> anchored;
};

// Adds the gradients with respect to the anchors after the substep to those of the state at its end, and returns the
// part that belongs to the anchors before it.
template <class T>
std::vector<V3<T>> end_anchors_vjp(const Model& m, const T* params, const SubstepRecord<T>& r, const T& step_length,
                                   StateGradient<T>& g, Workspace<T>& w) {
  std::vector<V3<T>> grad_anchor(m.na, V3<T>::Zero());
  if (m.na == 0) return grad_anchor;
  contact_anchors_vjp<T>(m, params, step_length, r.anchors.data(), r.anchored.data(), w, g.anchors.data(), g.q, g.v,
                         grad_anchor.data());
  marker_anchors_vjp<T>(m, params, step_length, r.anchors.data(), r.anchored.data(), w, g.anchors.data(), g.q, g.v,
                        grad_anchor.data());
  return grad_anchor;
}

// The multiplier where rounding errors made the Jacobian singular: far from the world's origin the inertia of a rotation
// is a difference of much larger numbers, inertias about the origin, and may become 0. The diagonal changes by the
// rounding error of these numbers.
template <class T>
void solve_nearly_singular(const Model& m, const T* params, const StepStart<T>& start, const VX<T>& v, const VX<T>& b,
                           Workspace<T>& w, VX<T>& multiplier) {
  evaluate<true, T>(m, params, start, v.data(), CacheState::stale, false, w);
  reduce_couplings<T>(m, w.layout, w.tangent);
  remove_prescribed<T>(m, w.layout, w.tangent);
  transpose_tangent<T>(w);
  for (const int k : m.articulated_dofs) {
    if (m.angular[k])
      w.tangent.in_tree(k, k) += Eigen::NumTraits<T>::epsilon() * w.composite[m.dof_body[k]].inertia.trace();
  }
  factorize_tangent<T>(w);
  solve_tangent<T>(w, b, multiplier);
}

// Transforms g from the gradient at the substep's end to the gradient at its start, and adds to grad_u.
// `on_multiplier`(c) is called before the gradient of the anchors changes.
template <class T, class OnMultiplier>
void substep_vjp(const Model& m, const T* params, const T* u, const SubstepRecord<T>& r, StateGradient<T>& g, T* grad_u,
                 StepMemory<T>& memory, OnMultiplier&& on_multiplier) {
  Workspace<T>& w = memory.work;
  const StepStart<T> start = r.start(u);
  evaluate<true, T>(m, params, start, r.v1.data(), CacheState::stale, false, w);
  std::vector<V3<T>> grad_anchor = end_anchors_vjp<T>(m, params, r, start.length(), g, w);
  VX<T> grad_increment = VX<T>::Zero(m.nv), grad_v0 = grad_increment;  // through the history after the step
  if (m.nh > 0 && r.full_step) {
    grad_increment = g.history.head(m.nv);
    grad_v0 = g.history.segment(m.nv, m.nv);
  }
  VX<T> b = g.v + r.beta_h * (dposition_dincrement_vjp<T>(m, w.increment, g.q) + grad_increment);
  reduce_couplings<T>(m, b);
  reduce_couplings<T>(m, w.layout, w.tangent);
  const PrescribedGradient<T> prescribed(m, w.layout, b, w.tangent);
  remove_prescribed<T>(m, b);
  remove_prescribed<T>(m, w.layout, w.tangent);
  transpose_tangent<T>(w);
  factorize_tangent<T>(w);
  VX<T> multiplier(m.nv);
  solve_tangent<T>(w, b, multiplier);
  if (!multiplier.allFinite()) [[unlikely]] {
    solve_nearly_singular<T>(m, params, start, r.v1, b, w, multiplier);
  }
  expand_couplings<T>(m, multiplier);
  on_multiplier(multiplier);
  for (std::size_t a = 0; a < m.actuators.size(); ++a) {
    grad_u[a] -= along_transmission<T>(m, m.actuators[a], multiplier) * w.dg_du[a];
  }
  const VX<T> grad_q1 = g.q - transposed_times<T>(w, w.dg_dq, multiplier);
  VX<T> grad_v_star = transposed_times<T>(w, w.mass, multiplier), grad_v_before = VX<T>::Zero(m.nv);  // v_{t-2}
  grad_increment += dposition_dincrement_vjp<T>(m, w.increment, grad_q1);
  free_bodies_vjp<T>(m, params, start, w, multiplier, grad_v_star, grad_increment, grad_v_before);
  g.q = dposition_dposition_vjp<T>(m, w.increment, grad_q1);
  g.v = grad_v0 + (r.bdf2 ? T(4) / T(3) : T(1)) * grad_v_star;
  prescribed.add(multiplier, g.v);
  g.history.setZero();
  if (r.bdf2) {
    g.history.head(m.nv) = grad_increment / T(3);
    g.history.segment(m.nv, m.nv) = grad_v_before - grad_v_star / T(3);
  }
  if (m.na > 0) {
    residual_anchors_vjp<T>(m, params, r.beta_h, r.bdf2, r.anchors.data(), r.anchored.data(), w, multiplier,
                            grad_anchor.data());
    g.anchors.swap(grad_anchor);
  }
}

// Transforms g from the gradient at a state whose followers were set by their leaders to that at the state before.
template <class T>
void follow_leaders_vjp(const Model& m, StateGradient<T>& g) {
  reduce_couplings<T>(m, g.q);
  reduce_couplings<T>(m, g.v);
  if (m.nh == 0) return;
  for (int part = 0; part < 2; ++part) {
    VX<T> rates = g.history.segment(part * m.nv, m.nv);
    reduce_couplings<T>(m, rates);
    g.history.segment(part * m.nv, m.nv) = rates;
  }
}

// Adds the gradient of marker readings at a state to g.
template <class T>
void tactile_vjp(const Model& m, const T* params, const StateView<T>& s, const T* grad_reading, StateGradient<T>& g,
                 Workspace<T>& w) {
  forward_state<true, T>(m, params, s.q, s.q_rounding, s.v, w);
  read_markers_vjp<T>(m, params, s.anchors, s.anchored, w, grad_reading, g.q, g.v, g.anchors.data());
}

}  // namespace gelflow
