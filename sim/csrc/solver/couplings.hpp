// Joints that follow others linearly, by exact elimination. With v = E w, w the velocities of all other dofs and E the
// constant matrix of the ratios, a step solves
//
//     Eᵀ g(E w) = 0,    Jacobian Eᵀ J E,    so that J⁻¹ is E (Eᵀ J E)⁻¹ Eᵀ wherever the solver uses it.
//
// Vectors and matrices keep their size: rows and columns of followers are 0, with 1 on the diagonal. The position of a
// follower, its velocity and their history are defined by those of its leader (follow_leaders, step.hpp).
//
// A prescribed velocity keeps its value: its equation and its unknown leave the system in the same way.
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

// Sets row and column k to those of the identity.
template <class T>
void set_identity_at(typename IslandMatrix<T>::Block& block, int k) {
  block.row(k).setZero();
  block.col(k).setZero();
  block(k, k) = T(1);
}

// A ← Eᵀ A E.
template <class T>
void reduce_couplings(const Model& m, const IslandLayout& layout, IslandMatrix<T>& a) {
  for (const Coupling& c : m.couplings) {
    const int dof = layout.column()[c.dof];
    auto block = a.block(layout.island_of(c.dof));
    if (c.leader_dof >= 0) {
      const int leader = layout.column()[c.leader_dof];
      block.row(leader) += T(c.ratio) * block.row(dof);
      block.col(leader) += T(c.ratio) * block.col(dof);
    }
    set_identity_at<T>(block, dof);
  }
}

// Removes the rows (and below the columns) of prescribed velocities.
template <class T>
void remove_prescribed(const Model& m, VX<T>& x) {
  for (const int k : m.prescribed_dofs) x[k] = T(0);
}

template <class T>
void remove_prescribed(const Model& m, const IslandLayout& layout, IslandMatrix<T>& a) {
  for (const int k : m.prescribed_dofs) {
    auto block = a.block(layout.island_of(k));
    set_identity_at<T>(block, layout.column()[k]);
  }
}

// The gradient with respect to prescribed velocities: with b and A of the reverse pass (adjoint.hpp) before they are
// removed from it, and its multiplier c, b_k − Σ_j A_jk c_j.
template <class T>
class PrescribedGradient {
 public:
  PrescribedGradient(const Model& m, const IslandLayout& layout, const VX<T>& b, const IslandMatrix<T>& a)
      : m_(m), layout_(layout) {
    for (const int k : m.prescribed_dofs) {
      b_.push_back(b[k]);
      columns_.emplace_back(a.block(layout.island_of(k)).col(layout.column()[k]));
    }
  }
  void add(const VX<T>& multiplier, VX<T>& grad_v) const {
    for (std::size_t i = 0; i < b_.size(); ++i) {
      T& sum = grad_v[m_.prescribed_dofs[i]];
      sum += b_[i];
      layout_.for_dofs(layout_.island_of(m_.prescribed_dofs[i]),
                       [&](int j) { sum -= columns_[i][layout_.column()[j]] * multiplier[j]; });
    }
  }

 private:
  const Model& m_;
  const IslandLayout& layout_;
  std::vector<T> b_;
  std::vector<VX<T>> columns_;
};

}  // namespace gelflow
