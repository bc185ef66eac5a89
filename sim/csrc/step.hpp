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
#include <bit>
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
  double softness = 1;  // share of k_t, k_s, dry friction's slope and actuators' gains at work: 1 but on Newton's way
};

struct StepReport {
  Status status = Status::ok;
  int iterations = 0;  // Newton iterations, substeps included
  int halvings = 0;    // of the step, to get the shortest of its substeps
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
ActuatorPull<T> actuator_pull(const Actuator& actuator, const T* p, const T& u, const T* q, const T* v,
                              double softness = 1) {
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
  if (softness < 1) {
    pull.force *= T(softness);
    pull.by_length *= T(softness);
    pull.by_speed *= T(softness);
  }
  if (pull.force < p[3] || pull.force > p[4]) {
    const bool below = pull.force < p[3];
    return {below ? p[3] : p[4], T(0), T(0), T(0), pull.clipped | (below ? 4 : 8)};
  }
  return pull;
}

// Joint-space forces: damping, friction, springs, limits, actuators. Adds −h f and its derivatives to the residual.
template <bool derivatives, class T>
void subtract_joint_forces(const Model& m, const T* params, const T& h, const T* q, const T* v, const T* u,
                           double softness, bool scale, Workspace<T>& w) {
  using std::abs;
  const T creep(friction_creep / softness);
  for (const Joint& joint : m.joints) {
    const T* p = params + joint.param;
    const T damping = p[0], armature = p[1], stiffness = p[2], rest = p[3];
    for (int k = joint.v; k < joint.v + joint.dofs; ++k) {
      w.residual[k] += h * damping * v[k];
      if constexpr (derivatives) w.by_v(k, k) += h * damping;
      if (p[8] != T(0)) {  // dry friction: viscous below this speed, constant above
        const bool slides = abs(v[k]) > creep;
        const T force = slides ? T(v[k] > T(0) ? p[8] : -p[8]) : T(p[8] / creep * v[k]);
        w.residual[k] += h * force;
        if (scale) w.forces[k] += h * p[8];
        if constexpr (derivatives) w.by_v(k, k) += slides ? T(0) : T(h * p[8] / creep);
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
    const ActuatorPull<T> pull = actuator_pull<T>(actuator, p, u[a], q, v, softness);
    w.residual[k] -= h * gear * pull.force;
    if (scale) w.forces[k] += h * abs(gear * pull.force);
    if constexpr (derivatives) {
      w.by_u[a] = -h * gear * pull.by_u;
      w.by_q(k, k) -= h * gear * gear * pull.by_length;
      w.by_v(k, k) -= h * gear * gear * pull.by_speed;
    }
  }
}

// Residual at (w.q, v); w.tangent = ∂g/∂v_t where derivatives are asked for. `scale` also sets w.forces, the impulses at
// work there, which Newton's tolerance refers to (they take the mass matrix of the last evaluation with derivatives).
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
    for (int k = 0; k < m.nv; ++k) w.forces[k] = h * w.mass(k, k) * (m.angular[k] ? T(98.1) : T(9.81));
  }
  subtract_joint_forces<derivatives, T>(m, params, h, w.q.data(), v, from.u, from.softness, scale, w);
  subtract_contact_forces<derivatives, T>(m, params, h, from.anchors, from.anchored, from.softness, scale, w);
  if constexpr (derivatives) {
    w.tangent = h * w.by_q;
    times_position_by_increment<T>(m, w.increment, w.tangent);
    w.tangent += w.by_v;
  }
}

// Size of the residual relative to impulses.
template <class T>
double relative(const VX<T>& residual, const VX<T>& impulses) {
  double sum = 0;
  for (Eigen::Index k = 0; k < residual.size(); ++k) {
    const double value = real_part(residual[k]) / std::max<double>(real_part(impulses[k]), 1e-30);
    if (!std::isfinite(value)) return std::numeric_limits<double>::infinity();
    sum += value * value;
  }
  return std::sqrt(sum);
}

// Whether the residual may be rounding errors alone: those of the impulses, of the momenta before the step (whose moments
// are taken about the world's origin), and of what one rounding unit of every position and velocity makes.
template <class T>
bool at_rounding_floor(const Model& m, const T* params, const StepStart<T>& from, const VX<T>& v,
                       const Workspace<T>& w) {
  using std::abs;
  const double unit = 20 * real_part(Eigen::NumTraits<T>::epsilon());
  double reach = 0, mass = 0, speed = 0, spin = 0;
  for (int k = 0; k < m.nq; ++k) reach = std::max(reach, std::abs(real_part(from.q0[k])));
  for (const Body& body : m.bodies) mass += std::abs(real_part(params[body.mass]));
  for (int k = 0; k < m.nv; ++k) {
    double& fastest = m.angular[k] ? spin : speed;
    fastest = std::max(fastest, std::abs(real_part(from.v_star[k])));
  }
  const double momentum = mass * (speed + reach * spin) * (1 + real_part(from.h) * spin);
  for (int i = 0; i < m.nv; ++i) {
    double own = m.angular[i] ? reach * momentum : momentum, stiffness = 0;
    for (int j = 0; j < m.nv; ++j) {
      stiffness += std::abs(real_part(w.by_q(i, j)));
      own += std::abs(real_part(w.by_v(i, j))) * (std::abs(real_part(v[j])) + std::abs(real_part(from.v_star[j])));
    }
    const double bound = unit * (stiffness * reach + own + real_part(w.forces[i]));
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
// starts from the best point seen. Where the search gets stuck at an edge, the derivatives just past it say where to go.
template <class T>
Status newton(const Model& m, const T* params, const StepStart<T>& from, int polish, VX<T>& v, int& iterations,
              Workspace<T>& w) {
  constexpr int full_steps = 6, patience = 6;
  const double own = std::max(m.tolerance, 1000 * static_cast<double>(real_part(Eigen::NumTraits<T>::epsilon())));
  const double tolerance = from.softness < 1 ? std::max(own, 1e-3) : own;
  bool fresh = false;  // w holds the derivatives at v
  const auto measure = [&](bool derivatives) {
    if (derivatives) {
      evaluate<true, T>(m, params, from, v.data(), true, w);
    } else {
      evaluate<false, T>(m, params, from, v.data(), true, w);
    }
    fresh = derivatives;
    return relative(w.residual, w.scale);
  };
  measure(true);
  w.scale = w.forces;  // what residuals are compared by
  double size = relative(w.residual, w.scale), best = size, before = size, mark = size;
  if (!std::isfinite(size)) return Status::not_finite;
  w.best = v;
  bool settled = false;  // no better residual can be had
  bool past = false;     // v lies just past an edge; the search goes on from w.start before it
  for (int k = 0; k <= m.max_iterations; ++k) {
    const bool converged = settled || relative(w.residual, w.forces) <= tolerance;
    if (converged && polish-- <= 0) return Status::ok;
    if (k == m.max_iterations || iterations >= m.max_step_iterations) break;
    if (!fresh) size = measure(true);
    w.lu.compute(w.tangent);
    w.direction = w.lu.solve(w.residual);
    if (past) {
      w.direction += w.start - v;
    } else {
      w.start = v;
      before = size;
    }
    ++iterations;
    const bool search = k >= full_steps && !converged;
    double fraction = 1;
    bool better = false;
    for (int tries = 0; tries < 13; ++tries, fraction *= 0.5) {
      v = w.start - w.direction * T(fraction);
      size = measure(k == 0);  // the first update is seldom the last: its derivatives will be needed
      better = size <= (1 - 1e-4 * fraction) * before;
      if (better || converged) break;
      settled = std::isfinite(size) && at_rounding_floor<T>(m, params, from, v, w);
      if (settled || (std::isfinite(size) && !search)) break;
    }
    if (size < best) {
      best = size;
      w.best = v;
    } else if (k + 1 == full_steps && !settled) {
      v = w.best;
      mark = best;
      size = measure(true);
    }
    if (!search || settled) continue;
    if (!better && (past || !std::isfinite(size))) break;
    past = !better;
    if ((k - full_steps) % patience == patience - 1) {
      if (best > 0.5 * mark) break;
      mark = best;
    }
  }
  return Status::newton;
}

// Where Newton did not converge. Mostly something saturates: points stick below a tiny speed and slip above it, a servo
// follows within a tiny error and pulls with its limit beyond. Full steps jump back and forth over that narrow range,
// and a search gets stuck beside it. So k_t, k_s and the gains start soft, which makes the range wide, and grow to what
// they are, each solution being the next one's start.
template <class T>
Status newton_from_softer(const Model& m, const T* params, const StepStart<T>& from, int polish, VX<T>& v,
                          int& iterations, Workspace<T>& w) {
  constexpr double softest = 1e-8, least_growth = 1.3;
  StepStart<T> soft = from;
  VX<T> reached = v;
  double solved = 0, growth = 100;
  for (soft.softness = softest;;) {
    v = reached;
    const Status status = newton<T>(m, params, soft, soft.softness < 1 ? 0 : polish, v, iterations, w);
    if (status == Status::ok) {
      if (soft.softness == 1) return status;
      reached = v;
      solved = soft.softness;
    } else {
      growth = std::sqrt(growth);
      if (solved == 0 || growth < least_growth) return status;
    }
    soft.softness = std::min(1.0, solved * growth);
  }
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

// How a substep of length h, `whole` or a part of the step, starts from state s: β, v* and γ δ, which are kept in `memory`.
template <class T>
StepStart<T> start_of(const Model& m, const T& h, bool whole, const StateView<T>& s, const T* u,
                      StepMemory<T>& memory) {
  memory.v_star = Eigen::Map<const VX<T>>(s.v, m.nv);
  StepStart<T> from{h, s.q, memory.v_star.data(), nullptr, s.anchors, s.anchored, u};
  if (m.nh == 0 || !whole || !(s.history[2 * m.nv] > T(0))) return from;
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

// One substep of length h from state s, which moves on only if the substep succeeds. `whole`: it is the step itself, not
// a part of it.
template <class T, class Observer>
Status substep(const Model& m, const T* params, const T& h, bool whole, const T* u, int polish, const StateView<T>& s,
               StepMemory<T>& memory, int& iterations, Observer&& accepted) {
  const StepStart<T> from = start_of<T>(m, h, whole, s, u, memory);
  memory.v_new = Eigen::Map<const VX<T>>(s.v, m.nv);
  Status status = newton<T>(m, params, from, polish, memory.v_new, iterations, memory.work);
  if (status != Status::ok) {
    memory.v_new = Eigen::Map<const VX<T>>(s.v, m.nv);
    status = newton_from_softer<T>(m, params, from, polish, memory.v_new, iterations, memory.work);
  }
  if (status != Status::ok) return status;
  accepted(from, memory);
  advance_contact_anchors<T>(m, params, s.anchors, s.anchored, memory.work, s.anchors, s.anchored);
  advance_marker_anchors<T>(m, params, s.anchors, s.anchored, memory.work, s.anchors, s.anchored);
  if (m.nh > 0) {
    std::fill(s.history, s.history + m.nh, T(0));
    if (whole) {
      std::copy(memory.work.increment.data(), memory.work.increment.data() + m.nv, s.history);
      std::copy(s.v, s.v + m.nv, s.history + m.nv);
      s.history[2 * m.nv] = T(1);
    }
  }
  std::copy(memory.work.q.data(), memory.work.q.data() + m.nq, s.q);
  std::copy(memory.v_new.data(), memory.v_new.data() + m.nv, s.v);
  return Status::ok;
}

// One step of length m.step. Where Newton does not converge, a substep of half the length is tried, down to
// step / 2^max_halvings, and after two that succeed one of twice the length again. Where even the shortest fails, the
// state is left as it was and the report says why.
template <class T, class Observer = NoObserver>
StepReport step(const Model& m, const T* params, const T* u, int polish, const StateView<T>& s, StepMemory<T>& memory,
                Observer&& accepted = {}) {
  StepReport report;
  memory.keep(m, s);
  const int whole = 1 << m.max_halvings;  // lengths in units of the shortest substep
  for (int at = 0, length = whole; at < whole;) {
    const T h = length == whole ? T(m.step) : T(m.step * length / whole);
    report.status = substep<T>(m, params, h, length == whole, u, polish, s, memory, report.iterations, accepted);
    if (report.status == Status::ok) {
      at += length;
      if (at % (2 * length) == 0 && at + 2 * length <= whole) length *= 2;
    } else if (length > 1 && report.iterations < m.max_step_iterations) {
      length /= 2;
      report.halvings = std::max(report.halvings, std::countr_zero(static_cast<unsigned>(whole / length)));
    } else {
      memory.give_back(m, s);
      return report;
    }
  }
  return report;
}

}  // namespace gelflow
