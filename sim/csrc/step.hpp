// One implicit step (eqs. 6-7): the residual with its derivatives, Newton's method with line search, and halving.
//
//     q_t = q_{t-1} ⊕ (β h v_t + γ δ),   δ = q_{t-1} ⊖ q_{t-2}
//     g(v_t) = M(q_t) (v_t − v*) + β h (C(q_t, v_t) − f(q_t, v_t, u)) = 0
//     BDF1: β = 1, γ = 0, v* = v_{t-1}         BDF2: β = 2/3, γ = 1/3, v* = 4/3 v_{t-1} − 1/3 v_{t-2}
//
// written as g = β h · (inverse dynamics of (q_t, v_t, (v_t − v*)/(β h)) − f), and solved for v_t. In the code h is β h.
// BDF2 starts with one step of BDF1, whose local error is of BDF2's order, and does so again after a halved step.
#pragma once

#include <algorithm>
#include <cstring>

#include "contact.hpp"
#include "dynamics.hpp"
#include "tactile.hpp"

namespace gelflow {

enum class Status : std::int32_t { ok = 0, newton = 1, not_finite = 2 };

// The state of one environment. Anchors live in the frame of the shape that they touch. History is BDF2's: δ (nv),
// v_{t-2} (nv), and 1 where there is one, else 0.
template <class T>
struct StateView {
  T* q;
  T* v;
  V3<T>* anchors;
  std::uint8_t* anchored;
  T* history;
};

// What a step's residual needs beside v_t.
template <class T>
struct StepStart {
  T h;  // β h
  const T *q0, *v_star;
  const T* shift;  // γ δ, null under BDF1
  const V3<T>* anchors;
  const std::uint8_t* anchored;
  const T* u;
};

struct StepReport {
  Status status = Status::ok;
  int iterations = 0;  // Newton iterations, substeps included
  int halvings = 0;    // the step was taken as 2^halvings substeps
};

// Below this speed dry friction in a joint is viscous [m/s or rad/s].
constexpr double friction_creep = 1e-3;

// A limit pushes back like a damped spring and never pulls; p: the joint's parameters.
template <class T>
struct LimitPush {
  T force, by_q, by_v;
};
template <class T>
LimitPush<T> limit_push(const T* p, const T& value, const T& v) {
  const bool above = value > p[5], below = value < p[4];
  if (!above && !below) return {T(0), T(0), T(0)};
  const T force = p[6] * (value - (above ? p[5] : p[4])) + p[7] * v;
  if (above ? force > T(0) : force < T(0)) return {force, p[6], p[7]};
  return {T(0), T(0), T(0)};
}

// What an actuator pulls with, and its derivatives by the control, its length and its speed (gear × those of the joint).
template <class T>
struct ActuatorPull {
  T force, by_u, by_length, by_speed;
  int clipped;  // bits: 1 control below, 2 above its range; 4 force below, 8 above
};
template <class T>
ActuatorPull<T> actuator_pull(const Actuator& actuator, const T* p, const T& u, const T* q, const T* v) {
  const T gear = p[0], kp = p[1], kd = p[2];
  ActuatorPull<T> pull{T(0), T(1), T(0), T(0), 0};
  T bias = T(0);
  switch (actuator.kind) {
    case ActuatorKind::motor:
      break;
    case ActuatorKind::position:
      pull = {T(0), kp, -kp, -kd, 0};
      break;
    case ActuatorKind::velocity:
      pull = {T(0), kd, T(0), -kd, 0};
      break;
    case ActuatorKind::general:
      pull = {T(0), p[7], -kp, -kd, 0};
      bias = p[8];
      break;
  }
  const T gain = pull.by_u;
  T control = u;
  if (u < p[5] || u > p[6]) {
    pull.clipped = u < p[5] ? 1 : 2;
    control = u < p[5] ? p[5] : p[6];
    pull.by_u = T(0);
  }
  pull.force =
      gain * control + bias + pull.by_length * (gear * q[actuator.q]) + pull.by_speed * (gear * v[actuator.dof]);
  if (pull.force < p[3] || pull.force > p[4]) {
    const bool below = pull.force < p[3];
    return {below ? p[3] : p[4], T(0), T(0), T(0), pull.clipped | (below ? 4 : 8)};
  }
  return pull;
}

// Joint-space forces: damping, friction, springs, limits, actuators. Adds −h f and its derivatives to the residual.
template <bool derivatives, class T>
void subtract_joint_forces(const Model& m, const T* params, const T& h, const T* q, const T* v, const T* u, bool scale,
                           Workspace<T>& w) {
  using std::abs;
  for (const Joint& joint : m.joints) {
    const T* p = params + joint.param;
    const T damping = p[0], armature = p[1], stiffness = p[2], rest = p[3];
    for (int k = joint.v; k < joint.v + joint.dofs; ++k) {
      w.residual[k] += h * damping * v[k];
      if constexpr (derivatives) w.by_v(k, k) += h * damping;
      if (p[8] != T(0)) {  // dry friction: viscous below this speed, constant above
        const bool slides = abs(v[k]) > T(friction_creep);
        const T force = slides ? T(v[k] > T(0) ? p[8] : -p[8]) : T(p[8] / T(friction_creep) * v[k]);
        w.residual[k] += h * force;
        if (scale) w.scale[k] += h * p[8];
        if constexpr (derivatives) w.by_v(k, k) += slides ? T(0) : T(h * p[8] / T(friction_creep));
      }
      if (armature != T(0)) {
        w.residual[k] += armature * w.trial[k];  // w.trial holds v_t − v*
        if constexpr (derivatives) {
          w.by_v(k, k) += armature;
          w.mass(k, k) += armature;
        }
      }
    }
    if (joint.turns()) continue;
    const int k = joint.v;
    const T value = q[joint.q];
    w.residual[k] += h * stiffness * (value - rest);
    if constexpr (derivatives) w.by_q(k, k) += h * stiffness;
    const LimitPush<T> push = limit_push<T>(p, value, v[k]);
    w.residual[k] += h * push.force;
    if constexpr (derivatives) {
      w.by_q(k, k) += h * push.by_q;
      w.by_v(k, k) += h * push.by_v;
    }
  }
  for (std::size_t a = 0; a < m.actuators.size(); ++a) {
    const Actuator& actuator = m.actuators[a];
    const T* p = params + actuator.param;
    const T gear = p[0];
    const int k = actuator.dof;
    const ActuatorPull<T> pull = actuator_pull<T>(actuator, p, u[a], q, v);
    w.residual[k] -= h * gear * pull.force;
    if (scale) w.scale[k] += h * abs(gear * pull.force);
    if constexpr (derivatives) {
      w.by_u[a] = -h * gear * pull.by_u;
      w.by_q(k, k) -= h * gear * gear * pull.by_length;
      w.by_v(k, k) -= h * gear * gear * pull.by_speed;
    }
  }
}

// Residual at (w.q, v); w.tangent = ∂g/∂v_t where derivatives are asked for. `scale` also sets w.scale, the size of
// the forces at work, which Newton's tolerance refers to.
template <bool derivatives, class T>
void evaluate(const Model& m, const T* params, const StepStart<T>& from, const T* v, bool scale, Workspace<T>& w) {
  const T& h = from.h;
  for (int k = 0; k < m.nv; ++k) {
    w.trial[k] = v[k] - from.v_star[k];
    w.increment[k] = h * v[k];
    if (from.shift) w.increment[k] += from.shift[k];
  }
  integrate<T>(m, from.q0, w.increment, w.q.data());
  w.update = w.trial / h;  // accelerations
  forward_positions<T>(m, params, w.q.data(), w);
  forward_velocities<T>(m, params, v, w.update.data(), w);
  w.residual.setZero();
  if constexpr (derivatives) {
    w.by_q.setZero();
    w.by_v.setZero();
    w.mass.setZero();
  }
  add_inverse_dynamics<derivatives, T>(m, params, h, w);
  if constexpr (derivatives) w.by_v += w.mass;
  if (scale) {
    for (int k = 0; k < m.nv; ++k) w.scale[k] = h * w.mass(k, k) * (m.angular[k] ? T(98.1) : T(9.81));
  }
  subtract_joint_forces<derivatives, T>(m, params, h, w.q.data(), v, from.u, scale, w);
  subtract_contact_forces<derivatives, T>(m, params, h, from.anchors, from.anchored, scale, w);
  if constexpr (derivatives) {
    w.tangent = h * w.by_q;
    times_position_by_increment<T>(m, w.increment, w.tangent);
    w.tangent += w.by_v;
  }
}

template <class T>
double merit(const Workspace<T>& w) {
  double worst = 0;
  for (Eigen::Index k = 0; k < w.residual.size(); ++k) {
    const double value = real_part(w.residual[k]) / std::max<double>(real_part(w.scale[k]), 1e-30);
    if (!std::isfinite(value)) return std::numeric_limits<double>::infinity();
    worst += value * value;
  }
  return std::sqrt(worst);
}

// Whether the residual may be rounding errors alone: those of the forces that displacements of one rounding unit make.
template <class T>
bool at_rounding_floor(const Model& m, const Workspace<T>& w) {
  using std::abs;
  const double unit = 20 * real_part(Eigen::NumTraits<T>::epsilon());
  double reach = 0;
  for (const T& x : w.q) reach = std::max(reach, std::abs(real_part(x)));
  for (int i = 0; i < m.nv; ++i) {
    double stiffness = 0;
    for (int j = 0; j < m.nv; ++j) stiffness += std::abs(real_part(w.by_q(i, j)));
    const double bound = unit * (stiffness * reach + real_part(w.scale[i]));
    if (!(std::abs(real_part(w.residual[i])) <= bound)) return false;
  }
  return true;
}

// Solves one substep; on success `v` is v_t, and w holds residual and kinematics at (w.q, v).
// `polish` more Newton updates follow convergence (dual numbers need two for their derivative part).
//
// The first iterations take full steps whether the residual shrinks or not: contacts switch on and off, the residual is
// close to piecewise linear, and a full step into the right piece often makes the residual larger before the next one
// solves it, while a search along the line would stop at the first edge. Where that does not lead home, the search
// starts from the best point seen.
template <class T>
Status newton(const Model& m, const T* params, const StepStart<T>& from, int polish, VX<T>& v, int& iterations,
              Workspace<T>& w) {
  constexpr int full_steps = 8;
  const double tolerance = std::max(m.tolerance, 1000 * static_cast<double>(real_part(Eigen::NumTraits<T>::epsilon())));
  bool fresh = false;  // w holds the derivatives at v
  const auto measure = [&](bool derivatives, bool scale) {
    if (derivatives) {
      evaluate<true, T>(m, params, from, v.data(), scale, w);
    } else {
      evaluate<false, T>(m, params, from, v.data(), scale, w);
    }
    fresh = derivatives;
    return merit(w);
  };
  double size = measure(true, true), best = size;
  if (!std::isfinite(size)) return Status::not_finite;
  w.best = v;
  bool settled = false;  // no better residual can be had
  for (int k = 0; k < m.max_iterations; ++k) {
    const bool converged = settled || size <= tolerance;
    if (converged && polish-- <= 0) return Status::ok;
    if (!fresh) size = measure(true, false);
    w.lu.compute(w.tangent);
    w.direction = w.lu.solve(w.residual);
    w.start = v;
    ++iterations;
    const double before = size;
    double fraction = 1;
    for (int tries = 0;; ++tries) {
      v = w.start - w.direction * T(fraction);
      size = measure(k == 0, false);  // the first update is seldom the last: its derivatives will be needed
      if (converged || size <= (1 - 1e-4 * fraction) * before) break;
      if (std::isfinite(size) && at_rounding_floor<T>(m, w)) {
        settled = true;
        break;
      }
      if (std::isfinite(size) && k < full_steps) break;
      if (tries == 12) return Status::newton;  // a kink that Newton can not cross
      fraction *= 0.5;
    }
    if (size < best) {
      best = size;
      w.best = v;
    } else if (k + 1 == full_steps && !settled && size > tolerance) {
      v = w.best;
      size = measure(true, false);
    }
  }
  return settled || size <= tolerance ? Status::ok : Status::newton;
}

// One environment's memory for steps: the state to fall back on, and the state in the making.
template <class T>
struct StepMemory {
  explicit StepMemory(const Model& m)
      : work(m), q(m.nq), v(m.nv), v_new(m.nv), v_star(m.nv), shift(m.nv), history(m.nh) {}
  Workspace<T> work;
  VX<T> q, v, v_new, v_star, shift, history;
  std::vector<std::pair<int, V3<T>>> anchors;  // those that are set

  void keep(const Model& m, const StateView<T>& s) {
    q = Eigen::Map<const VX<T>>(s.q, m.nq);
    v = Eigen::Map<const VX<T>>(s.v, m.nv);
    history = Eigen::Map<const VX<T>>(s.history, m.nh);
    anchors.clear();
    constexpr int word = sizeof(std::uint64_t);  // most are not set: look at eight at a time
    for (int i = 0; i < m.na; i += word) {
      const int end = std::min(i + word, m.na);
      std::uint64_t any = 1;
      if (end - i == word) std::memcpy(&any, s.anchored + i, word);
      for (int k = i; any != 0 && k < end; ++k) {
        if (s.anchored[k]) anchors.emplace_back(k, s.anchors[k]);
      }
    }
  }
  void give_back(const Model& m, const StateView<T>& s) const {
    std::copy(q.data(), q.data() + m.nq, s.q);
    std::copy(v.data(), v.data() + m.nv, s.v);
    std::copy(history.data(), history.data() + m.nh, s.history);
    std::fill(s.anchored, s.anchored + m.na, 0);
    for (const auto& [i, anchor] : anchors) {
      s.anchors[i] = anchor;
      s.anchored[i] = 1;
    }
  }
};

// How a substep of length h, one of `count`, starts from state s: β, v* and γ δ, which are kept in `memory`.
template <class T>
StepStart<T> start_of(const Model& m, const T& h, int count, const StateView<T>& s, const T* u, StepMemory<T>& memory) {
  memory.v_star = Eigen::Map<const VX<T>>(s.v, m.nv);
  StepStart<T> from{h, s.q, memory.v_star.data(), nullptr, s.anchors, s.anchored, u};
  if (m.nh == 0 || count > 1 || !(s.history[2 * m.nv] > T(0))) return from;
  for (int k = 0; k < m.nv; ++k) {
    memory.v_star[k] = (T(4) * s.v[k] - s.history[m.nv + k]) / T(3);
    memory.shift[k] = s.history[k] / T(3);
  }
  from.h = h * T(2) / T(3);
  from.shift = memory.shift.data();
  return from;
}

// Called after each accepted substep with (its start, memory); memory.work holds the kinematics of its end.
struct NoObserver {
  template <class... A>
  void operator()(const A&...) const {}
};

// Takes `count` substeps of length h. On failure the state is left in the middle: the caller restores it.
template <class T, class Observer>
Status substeps(const Model& m, const T* params, const T& h, int count, const T* u, int polish, const StateView<T>& s,
                StepMemory<T>& memory, int& iterations, Observer&& accepted) {
  for (int i = 0; i < count; ++i) {
    const StepStart<T> from = start_of<T>(m, h, count, s, u, memory);
    memory.v_new = Eigen::Map<const VX<T>>(s.v, m.nv);
    const Status status = newton<T>(m, params, from, polish, memory.v_new, iterations, memory.work);
    if (status != Status::ok) return status;
    accepted(from, memory);
    advance_contact_anchors<T>(m, params, s.anchors, s.anchored, memory.work, s.anchors, s.anchored);
    advance_marker_anchors<T>(m, params, s.anchors, s.anchored, memory.work, s.anchors, s.anchored);
    if (m.nh > 0) {
      std::fill(s.history, s.history + m.nh, T(0));
      if (count == 1) {
        std::copy(memory.work.increment.data(), memory.work.increment.data() + m.nv, s.history);
        std::copy(s.v, s.v + m.nv, s.history + m.nv);
        s.history[2 * m.nv] = T(1);
      }
    }
    std::copy(memory.work.q.data(), memory.work.q.data() + m.nq, s.q);
    std::copy(memory.v_new.data(), memory.v_new.data() + m.nv, s.v);
  }
  return Status::ok;
}

// One step of length m.step. Where Newton does not converge the step is taken as 2, 4, … substeps; where even the
// shortest fail, the state is left as it was and the report says why.
template <class T, class Observer = NoObserver>
StepReport step(const Model& m, const T* params, const T* u, int polish, const StateView<T>& s, StepMemory<T>& memory,
                Observer&& accepted = {}) {
  StepReport report;
  memory.keep(m, s);
  for (; report.halvings <= m.max_halvings; ++report.halvings) {
    const int count = 1 << report.halvings;
    report.status = substeps<T>(m, params, T(m.step / count), count, u, polish, s, memory, report.iterations, accepted);
    if (report.status == Status::ok) return report;
    memory.give_back(m, s);
  }
  --report.halvings;
  return report;
}

}  // namespace gelflow
