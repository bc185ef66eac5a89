// The reverse pass of one step (eqs. 19-23).
//
// With b the gradient arriving at v_t, directly and through q_t = q_{t-1} ⊕ h v_t, and A = ∂g/∂v_t at the accepted state:
//     Aᵀ c = b,   ∂L/∂u −= cᵀ ∂g/∂u,   ∂L/∂v_{t-1} = Mᵀ c,
//     ∂L/∂q_{t-1} = (∂q_t/∂q_{t-1})ᵀ (∂L/∂q_t − (∂g/∂q_t)ᵀ c),   ∂L/∂X_{t-1} −= cᵀ ∂g/∂X_{t-1}.
// The anchors after the step hang on the state at its end: their gradient joins ∂L/∂q_t and ∂L/∂v_t first.
#pragma once

#include "step.hpp"

namespace gelflow {

// Gradients with respect to a state; q as a tangent vector.
template <class T>
struct StateGradient {
  explicit StateGradient(const Model& m) : q(VX<T>::Zero(m.nv)), v(VX<T>::Zero(m.nv)), anchors(m.na, V3<T>::Zero()) {}
  VX<T> q, v;
  std::vector<V3<T>> anchors;
};

// What the reverse pass needs of one accepted substep.
template <class T>
struct Record {
  T h;
  VX<T> q0, v0, v1;
  std::vector<V3<T>> anchors;
  std::vector<std::uint8_t> anchored;
};

// `g` enters as the gradient at the substep's end and leaves as the gradient at its start; by_u is added to. Before the
// anchors' gradient changes, multipliers(c) is called.
template <class T, class Multipliers>
void substep_transposed(const Model& m, const T* params, const T* u, const Record<T>& r, StateGradient<T>& g, T* by_u,
                        StepMemory<T>& memory, Multipliers&& multipliers) {
  Workspace<T>& w = memory.work;
  evaluate<true, T>(m, params, r.h, r.q0.data(), r.v0.data(), r.anchors.data(), r.anchored.data(), u, r.v1.data(),
                    false, w);
  std::vector<V3<T>> by_anchor(m.na, V3<T>::Zero());
  if (m.na > 0) {
    contact_anchors_transposed<true, T>(m, params, r.h, r.anchors.data(), r.anchored.data(), w, g.anchors.data(), g.v,
                                        g.q, g.v, by_anchor.data());
    marker_anchors_transposed<T>(m, params, r.h, r.anchors.data(), r.anchored.data(), w, g.anchors.data(), g.q, g.v,
                                 by_anchor.data());
  }
  const VX<T> b = g.v + position_by_velocity_transposed<T>(m, r.v1.data(), r.h, g.q);
  w.lu.compute(w.tangent.transpose());
  const VX<T> c = w.lu.solve(b);
  multipliers(c);
  for (std::size_t a = 0; a < m.actuators.size(); ++a) by_u[a] -= c[m.actuators[a].dof] * w.by_u[a];
  g.q = position_by_position_transposed<T>(m, r.v1.data(), r.h, VX<T>(g.q - w.by_q.transpose() * c));
  g.v = w.mass.transpose() * c;
  if (m.na > 0) {
    contact_anchors_transposed<false, T>(m, params, r.h, r.anchors.data(), r.anchored.data(), w, nullptr, c, g.q, g.v,
                                         by_anchor.data());
    g.anchors.swap(by_anchor);
  }
}

// Gradient of marker readings at a state, added to g.
template <class T>
void tactile_transposed(const Model& m, const T* params, const StateView<T>& s, const T* by_reading,
                        StateGradient<T>& g, Workspace<T>& w) {
  w.update.setZero();
  forward_positions<T>(m, params, s.q, w);
  forward_velocities<T>(m, params, s.v, w.update.data(), w);
  read_markers_transposed<T>(m, params, T(m.step), s.anchors, s.anchored, w, by_reading, g.q, g.v, g.anchors.data());
}

}  // namespace gelflow
