// One implicit step (eqs. 6-7):
//
//     q_t = q_{t-1} ⊕ (β h v_t + γ δ),   δ = q_{t-1} ⊖ q_{t-2}
//     g(v_t) = M(q_t) (v_t − v*) + β h (C(q_t, v_t) − f(q_t, v_t, u)) = 0
//     BDF1: β = 1, γ = 0, v* = v_{t-1}         BDF2: β = 2/3, γ = 1/3, v* = 4/3 v_{t-1} − 1/3 v_{t-2}
//
// solved for v_t (residual.hpp, newton.hpp). If the solver fails, the step is divided into substeps. BDF2 starts with one
// step of BDF1, whose local error is of the order of BDF2's, and restarts after a step that was divided.
//
// Equation numbers are those of the appendix of Xu et al., "Efficient Tactile Simulation with Differentiability for
// Robotic Manipulation", CoRL 2022.
#pragma once

#include <algorithm>
#include <bit>
#include <cstring>

#include "contact/contact_anchors.hpp"
#include "contact/tactile.hpp"
#include "solver/newton.hpp"

namespace gelflow {

// The state of one environment. Anchors are expressed in the frame of the shape in contact. The history of BDF2: δ (nv),
// v_{t-2} (nv), and 1 if it is valid, else 0.
template <class T>
struct StateView {
  T* q;
  T* v;
  V3<T>* anchors;
  std::uint8_t* anchored;
  T* history;
  T* q_rounding = nullptr;  // single precision: rounding residual of q, so that small steps accumulate
};

// Calls visit(i) where set[i] is not 0. Most entries are 0: eight are tested at a time.
template <class Visit>
void for_each_set(const std::uint8_t* set, int n, Visit&& visit) {
  constexpr int word = sizeof(std::uint64_t);
  for (int i = 0; i < n; i += word) {
    const int end = std::min(i + word, n);
    std::uint64_t any = 1;
    if (end - i == word) std::memcpy(&any, set + i, word);
    for (int k = i; any != 0 && k < end; ++k) {
      if (set[k]) visit(k);
    }
  }
}

// Sets positions, velocities and the history of the followers in state s.
template <class T>
void follow_leaders(const Model& m, const StateView<T>& s) {
  for (const Coupling& c : m.couplings) {
    PositionScalar<T> position(c.offset);
    if (c.leader_q >= 0) position += PositionScalar<T>(c.ratio) * position_with_rounding(s.q, s.q_rounding, c.leader_q);
    s.q[c.q] = T(position);
    if (s.q_rounding != nullptr) s.q_rounding[c.q] = T(position - PositionScalar<T>(s.q[c.q]));
    const auto follow = [&](T* rates) { rates[c.dof] = c.leader_dof < 0 ? T(0) : T(T(c.ratio) * rates[c.leader_dof]); };
    follow(s.v);
    if (m.nh == 0) continue;
    follow(s.history);
    follow(s.history + m.nv);
  }
}

struct StepReport {
  Status status = Status::ok;
  int iterations = 0;  // Newton iterations, substeps included
  int halvings = 0;    // of the step length, for the shortest substep
};

// Memory for the steps of an environment: workspace, the state to restore after a failure, and the new state.
template <class T>
struct StepMemory {
  explicit StepMemory(const Model& m)
      : work(m), q(m.nq), q_rounding(VX<T>::Zero(m.nq)), v(m.nv), v_new(m.nv), v_star(m.nv), history(m.nh) {}
  Workspace<T> work;
  VX<T> q, q_rounding, v, v_new, v_star, history;
  std::vector<std::pair<int, V3<T>>> anchors;  // index and value of those that are set
  CacheState cache = CacheState::stale;        // state of the candidate points in `work`

  void save(const Model& m, const StateView<T>& s) {
    q = Eigen::Map<const VX<T>>(s.q, m.nq);
    if (s.q_rounding != nullptr) q_rounding = Eigen::Map<const VX<T>>(s.q_rounding, m.nq);
    v = Eigen::Map<const VX<T>>(s.v, m.nv);
    history = Eigen::Map<const VX<T>>(s.history, m.nh);
    anchors.clear();
    for_each_set(s.anchored, m.na, [&](int i) { anchors.emplace_back(i, s.anchors[i]); });
  }
  void restore(const Model& m, const StateView<T>& s) const {
    std::copy(q.data(), q.data() + m.nq, s.q);
    if (s.q_rounding != nullptr) std::copy(q_rounding.data(), q_rounding.data() + m.nq, s.q_rounding);
    std::copy(v.data(), v.data() + m.nv, s.v);
    std::copy(history.data(), history.data() + m.nh, s.history);
    std::fill(s.anchored, s.anchored + m.na, 0);
    for (const auto& [i, anchor] : anchors) {
      s.anchors[i] = anchor;
      s.anchored[i] = 1;
    }
  }
};

// The start of a substep of length h from state s: β, v* (stored in `memory`) and δ. `full_step`: it is not a part of a
// divided step.
template <class T>
StepStart<T> step_start(const Model& m, const T& h, bool full_step, const StateView<T>& s, const T* u,
                        StepMemory<T>& memory) {
  memory.v_star = Eigen::Map<const VX<T>>(s.v, m.nv);
  StepStart<T> start{h, s.q, memory.v_star.data(), s.q_rounding, nullptr, s.anchors, s.anchored, u, memory.cache};
  if (m.nh == 0 || !full_step || !(s.history[2 * m.nv] > T(0))) return start;
  for (int k = 0; k < m.nv; ++k) memory.v_star[k] = (T(4) * s.v[k] - s.history[m.nv + k]) / T(3);
  start.beta_h = h * T(2) / T(3);
  start.history = s.history;
  return start;
}

// Default observer. Observers are called after each accepted substep with (its start, memory); memory.work holds the
// kinematics of its end.
struct NoObserver {
  template <class... A>
  void operator()(const A&...) const {}
};

// Takes one substep of length h; updates the state s only if the solver succeeds. `full_step`: it is not a part of a
// divided step.
template <class T, class Observer>
Status substep(const Model& m, const T* params, const T& h, bool full_step, const T* u, int polish,
               const StateView<T>& s, StepMemory<T>& memory, int& iterations, Observer&& accepted) {
  const StepStart<T> start = step_start<T>(m, h, full_step, s, u, memory);
  memory.v_new = Eigen::Map<const VX<T>>(s.v, m.nv);
  Status status = newton<T>(m, params, start, polish, memory.v_new, iterations, memory.work);
  memory.cache = CacheState::warm;
  if (status != Status::ok) {
    memory.v_new = Eigen::Map<const VX<T>>(s.v, m.nv);
    status = newton_by_continuation<T>(m, params, start, polish, memory.v_new, iterations, memory.work);
  }
  if (status != Status::ok) return status;
  accepted(start, memory);
  advance_contact_anchors<T>(m, params, start.length(), s.anchors, s.anchored, memory.work, s.anchors, s.anchored);
  advance_marker_anchors<T>(m, params, start.length(), s.anchors, s.anchored, memory.work, s.anchors, s.anchored);
  if (m.nh > 0) {
    std::fill(s.history, s.history + m.nh, T(0));
    if (full_step) {
      std::copy(memory.work.increment.data(), memory.work.increment.data() + m.nv, s.history);
      std::copy(s.v, s.v + m.nv, s.history + m.nv);
      s.history[2 * m.nv] = T(1);
    }
  }
  for (int i = 0; i < m.nq; ++i) {
    s.q[i] = T(memory.work.q[i]);
    if (s.q_rounding != nullptr) s.q_rounding[i] = T(memory.work.q[i] - PositionScalar<T>(s.q[i]));
  }
  std::copy(memory.v_new.data(), memory.v_new.data() + m.nv, s.v);
  return Status::ok;
}

// Takes one step of length m.step, or of one of its equal `parts`, which always use BDF1. If Newton's method fails, the
// substep is halved, down to 2^-max_halvings of the step, and after two successful substeps doubled again. If the
// shortest fails too, the state stays as it was and the report holds the reason. `same_environment`: memory was last
// used for a step of the same environment.
template <class T, class Observer = NoObserver>
StepReport step(const Model& m, const T* params, const T* u, int polish, const StateView<T>& s, StepMemory<T>& memory,
                bool same_environment, Observer&& accepted = {}, int parts = 1) {
  memory.cache = same_environment ? CacheState::warm : CacheState::stale;
  if (!same_environment) memory.work.knows_anchored_markers = false;
  StepReport report;
  const double span = m.step / parts;
  const int full_length = 1 << m.max_halvings;  // lengths in units of the shortest substep
  for (int at = 0, length = full_length; at < full_length;) {
    const T h = length == full_length ? T(span) : T(span * length / full_length);
    const bool full_step = length == full_length && parts == 1;
    if (at == 0 && length == full_length / 2) memory.save(m, s);  // only parts of a divided step may have to be undone
    report.status = substep<T>(m, params, h, full_step, u, polish, s, memory, report.iterations, accepted);
    if (report.status == Status::ok) {
      at += length;
      if (at % (2 * length) == 0 && at + 2 * length <= full_length) length *= 2;
    } else if (length > 1 && report.iterations < m.max_step_iterations) {
      length /= 2;
      report.halvings = std::max(report.halvings, std::countr_zero(static_cast<unsigned>(full_length / length)));
    } else {
      if (at > 0) memory.restore(m, s);
      return report;
    }
  }
  return report;
}

}  // namespace gelflow
