// Fixed tendons: springs, damping, dry friction, armature and limits act on the length Σ c_i q_i, and a force f along the
// tendon on each of its joints with c_i f.
#pragma once

#include "model/workspace.hpp"

namespace gelflow {

// Position and speed of what an actuator drives: a joint or a tendon.
template <class T>
struct Transmission {
  T position, speed;
};

template <class T, class Q>
Transmission<T> tendon_motion(const Tendon& tendon, const Q* q, const T* v) {
  Transmission<T> motion{T(0), T(0)};
  for (const Tendon::Term& term : tendon.terms) {
    motion.position += T(term.coefficient) * T(q[term.q]);
    motion.speed += T(term.coefficient) * v[term.dof];
  }
  return motion;
}

// Adds an impulse along the tendon that resists its motion, and its derivatives by length and speed.
template <bool derivatives, class T>
void add_tendon_impulse(const Tendon& tendon, const T& impulse, const T& dimpulse_dlength, const T& dimpulse_dspeed,
                        bool add_impulses, Workspace<T>& w) {
  using std::abs;
  for (const Tendon::Term& row : tendon.terms) {
    const T coefficient(row.coefficient);
    w.residual[row.dof] += coefficient * impulse;
    if (add_impulses) w.impulses[row.dof] += abs(coefficient * impulse);
    if constexpr (derivatives) {
      for (const Tendon::Term& column : tendon.terms) {
        const T product = coefficient * T(column.coefficient);
        w.dg_dq(row.dof, column.dof) += product * dimpulse_dlength;
        w.dg_dv(row.dof, column.dof) += product * dimpulse_dspeed;
      }
    }
  }
}

// The inertial impulse of the armature along the tendon.
template <class T>
T armature_impulse(const Tendon& tendon, const T& armature, const Workspace<T>& w) {
  T change(0);
  for (const Tendon::Term& term : tendon.terms) change += T(term.coefficient) * w.velocity_change[term.dof];
  return armature * change;
}

// Adds the armature of the tendons to the mass matrix.
template <class T>
void add_tendon_mass(const Model& m, const T* params, Workspace<T>& w) {
  for (const Tendon& tendon : m.tendons) {
    const T armature = tendon.params.in(params).armature;
    for (const Tendon::Term& row : tendon.terms) {
      for (const Tendon::Term& column : tendon.terms) {
        w.mass(row.dof, column.dof) += T(row.coefficient) * T(column.coefficient) * armature;
      }
    }
  }
}

}  // namespace gelflow
