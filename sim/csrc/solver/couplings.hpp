// Joints that follow others linearly, by exact elimination. With v = E w, w the velocities of all other dofs and E the
// constant matrix of the ratios, a step solves
//
//     Eᵀ g(E w) = 0,    Jacobian Eᵀ J E,    so that J⁻¹ is E (Eᵀ J E)⁻¹ Eᵀ wherever the solver uses it.
//
// Vectors and matrices keep their size: rows and columns of followers are 0, with 1 on the diagonal. The position of a
// follower, its velocity and their history are defined by those of its leader (follow_leaders, step.hpp).
#pragma once

#include "model/workspace.hpp"

namespace gelflow {

// x ← E x: velocities, or an update of them.
template <class T>
void expand_couplings(const Model& m, VX<T>& x) {
  for (const Coupling& c : m.couplings) x[c.dof] = c.leader_dof < 0 ? T(0) : T(T(c.ratio) * x[c.leader_dof]);
}

// x ← Eᵀ x: forces, or a gradient with respect to velocities.
template <class T>
void reduce_couplings(const Model& m, VX<T>& x) {
  for (const Coupling& c : m.couplings) {
    if (c.leader_dof >= 0) x[c.leader_dof] += T(c.ratio) * x[c.dof];
    x[c.dof] = T(0);
  }
}

// Eᵀ |x| for absolute impulses.
template <class T>
void reduce_absolute_couplings(const Model& m, VX<T>& x) {
  using std::abs;
  for (const Coupling& c : m.couplings) {
    if (c.leader_dof >= 0) x[c.leader_dof] += T(std::abs(c.ratio)) * x[c.dof];
    x[c.dof] = T(0);
  }
}

// A ← Eᵀ A E.
template <class T>
void reduce_couplings(const Model& m, typename Workspace<T>::Rows& a) {
  for (const Coupling& c : m.couplings) {
    if (c.leader_dof >= 0) {
      a.row(c.leader_dof) += T(c.ratio) * a.row(c.dof);
      a.col(c.leader_dof) += T(c.ratio) * a.col(c.dof);
    }
    for (int k = 0; k < m.nv; ++k) a(c.dof, k) = a(k, c.dof) = T(0);
    a(c.dof, c.dof) = T(1);
  }
}

}  // namespace gelflow
