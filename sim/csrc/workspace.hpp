// Everything one environment's step writes besides its state; allocated once, reused by every step.
#pragma once

#include <Eigen/LU>
#include <utility>
#include <vector>

#include "model.hpp"

namespace gelflow {

template <class T>
struct Workspace {
  explicit Workspace(const Model& m)
      : rotation(m.bodies.size()),
        position(m.bodies.size()),
        twist(m.bodies.size()),
        acceleration(m.bodies.size()),
        force(m.bodies.size()),
        inertia(m.bodies.size()),
        rate(m.bodies.size()),
        axis(m.nv),
        twist_before(m.nv),
        twist_after(m.nv),
        acceleration_before(m.nv),
        p(m.nv),
        q_missing(m.nv),
        v_missing(m.nv),
        residual(m.nv),
        forces(m.nv),
        scale(m.nv),
        increment(m.nv),
        update(m.nv),
        trial(m.nv),
        direction(m.nv),
        start(m.nv),
        best(m.nv),
        mass(m.nv, m.nv),
        by_q(m.nv, m.nv),
        by_v(m.nv, m.nv),
        by_u(m.actuators.size()),
        tangent(m.nv, m.nv),
        q(m.nq),
        lu(m.nv) {}

  // Kinematics, world frame; spatial vectors at the world's origin.
  std::vector<M3<T>> rotation;
  std::vector<V3<T>> position;
  std::vector<V6<T>> twist, acceleration, force;
  std::vector<M6<T>> inertia, rate;  // composite over the subtree: I and B (dynamics.hpp)
  std::vector<V6<T>> axis;           // S_k per dof
  std::vector<V6<T>> twist_before, twist_after, acceleration_before;  // around the dof's group

  std::vector<V6<T>> p, q_missing, v_missing;  // P, Q and P − S × V_after per dof (dynamics.hpp)

  // The step's residual g and its derivatives.
  VX<T> residual, forces, scale;
  VX<T> increment;               // q_t = q_{t-1} ⊕ increment
  VX<T> update, trial;           // accelerations; v_t − v*
  VX<T> direction, start, best;  // Newton's
  MX<T> mass, by_q, by_v;        // ∂g/∂v* = −mass, ∂g/∂q_t, ∂g/∂v_t at fixed q_t
  VX<T> by_u;                    // ∂g_dof/∂u per actuator
  MX<T> tangent;                 // ∂g/∂v_t in all: by_v + by_q ∂q_t/∂v_t
  VX<T> q;                       // q_t of the trial velocity
  Eigen::PartialPivLU<MX<T>> lu;

  std::vector<std::pair<int, V3<T>>> kept;  // anchors in the making (pair.hpp)
};

}  // namespace gelflow
