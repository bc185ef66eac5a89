// Joints that follow others by a polynomial: a damped spring on the deviation φ = q − P(q of the leader).
#pragma once

#include "model/workspace.hpp"

namespace gelflow {

// A polynomial and its first two derivatives at x.
template <class T>
struct PolynomialValue {
  T value, slope, curvature;
};
template <class T>
PolynomialValue<T> polynomial_at(const std::vector<double>& coefficients, const T& x) {
  PolynomialValue<T> p{T(0), T(0), T(0)};
  for (auto c = coefficients.rbegin(); c != coefficients.rend(); ++c) {  // Horner's scheme
    p.curvature = p.curvature * x + T(2) * p.slope;
    p.slope = p.slope * x + p.value;
    p.value = p.value * x + T(*c);
  }
  return p;
}

// Adds −β h f and its derivatives to the residual, f the forces of the springs.
template <bool derivatives, class T>
void subtract_polynomial_couplings(const Model& m, const T* params, const T& beta_h, const PositionScalar<T>* q,
                                   const T* v, bool add_impulses, Workspace<T>& w) {
  using std::abs;
  for (const PolynomialCoupling& c : m.polynomial_couplings) {
    const SpringParams<T>& p = c.params.in(params);
    const T stiffness = p.stiffness, damping = p.damping;
    const PolynomialValue<T> at = polynomial_at<T>(c.coefficients, T(q[c.leader_q]));
    const T rate = v[c.dof] - at.slope * v[c.leader_dof];
    const T impulse = beta_h * (stiffness * (T(q[c.q]) - at.value) + damping * rate);
    const int dofs[] = {c.dof, c.leader_dof};
    const T slopes[] = {T(1), T(-at.slope)};  // ∂φ/∂q
    for (int i = 0; i < 2; ++i) {
      w.residual[dofs[i]] += slopes[i] * impulse;
      if (add_impulses) w.impulses[dofs[i]] += abs(slopes[i] * impulse);
    }
    if constexpr (derivatives) {
      const T slope_rate = at.curvature * v[c.leader_dof];  // −∂φ̇/∂q of the leader
      for (int i = 0; i < 2; ++i) {
        for (int j = 0; j < 2; ++j) {
          w.dg_dq(dofs[i], dofs[j]) += beta_h * stiffness * slopes[i] * slopes[j];
          w.dg_dv(dofs[i], dofs[j]) += beta_h * damping * slopes[i] * slopes[j];
        }
        w.dg_dq(dofs[i], c.leader_dof) -= beta_h * damping * slopes[i] * slope_rate;
      }
      w.dg_dq(c.leader_dof, c.leader_dof) -= at.curvature * impulse;
    }
  }
}

}  // namespace gelflow
