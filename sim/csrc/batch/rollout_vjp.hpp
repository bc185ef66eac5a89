// The reverse pass through a rollout (adjoint.hpp).
#pragma once

#include "batch/param_gradient.hpp"
#include "batch/trajectory.hpp"
#include "solver/adjoint.hpp"

namespace gelflow {

// The gradient with respect to the marker forces of a reading, (markers, 3). `forces`: memory for it.
template <class T>
const T* grad_marker_forces(const Model& m, const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent, int read,
                            std::size_t e, std::vector<T>& forces) {
  const T* const grad_reading = cotangent.tactile + r.reading(m, read, e);
  if (r.reduction == nullptr) return grad_reading;
  forces.resize(static_cast<std::size_t>(m.num_markers) * 3);
  r.reduction->apply_vjp(grad_reading, forces.data());
  return forces.data();
}

// Adds the gradient through the markers that were read after `step` steps, to the state there and to the parameters.
// `read` is the last read that is not yet done.
template <class T>
void readings_vjp(const Model& m, const T* params, int step, std::size_t e, const Trajectory<T>& r,
                  const TrajectoryCotangent<T>& cotangent, double* grad_params, StateGradient<T>& gradient, int& read,
                  Workspace<T>& w) {
  const StateView<T> now = r.state(m, step, e);
  std::vector<T> forces;
  for (; read >= 0 && r.read_after[read] == step; --read) {
    const T* grad_reading = grad_marker_forces(m, r, cotangent, read, e, forces);
    tactile_vjp<T>(m, params, now, grad_reading, gradient, w);
    if (grad_params == nullptr) continue;
    const ParamState at{m.step, now.q, now.v, nullptr, nullptr, nullptr, now.anchors, now.anchored};
    add_reading_param_gradient(m, params, at, grad_reading, grad_params);
  }
}

// The substeps of the step from state `old` to state `now`. A step that was halved is taken again, which gives the start
// and the anchors of each substep.
template <class T>
void record_substeps(const Model& m, const T* params, const T* u, const StateView<T>& old, const StateView<T>& now,
                     bool halved, StepMemory<T>& memory, std::vector<SubstepRecord<T>>& records) {
  records.clear();
  if (!halved) {
    const StepStart<T> start = step_start<T>(m, T(m.step), true, old, u, memory);
    records.emplace_back(m, start, Eigen::Map<const VX<T>>(now.v, m.nv), true);
    return;
  }
  StateCopy<T> scratch(m, old);
  gelflow::step<T>(m, params, u, m.polish, scratch.view(), memory, false,
                   [&](const StepStart<T>& start, const StepMemory<T>& taken) {
                     records.emplace_back(m, start, taken.v_new, false);
                   });
}

// The reverse pass of environment e. Gradients by parameters need T = double. The state does not change after a touch
// stop, nor where the environment rests: there the gradient passes, and later readings add to it. `ends` is asked before
// each step; where it returns true, the gradient is incomplete.
template <class T, class Ends>
void rollout_vjp(const Model& m, const T* params, std::size_t e, const Trajectory<T>& r,
                 const TrajectoryCotangent<T>& cotangent, const TrajectoryGradient<T>& out, StepMemory<T>& memory,
                 const Ends& ends) {
  double* grad_params = out.params == nullptr ? nullptr : out.params + e * m.param_names.size();
  StateGradient<T> gradient(m);
  std::copy_n(reinterpret_cast<const V3<T>*>(cotangent.anchors_end) + e * m.na, m.na, gradient.anchors.begin());
  std::copy_n(cotangent.history_end + e * m.nh, m.nh, gradient.history.data());
  std::vector<SubstepRecord<T>> records;
  int read = r.active[e] == 0 ? -1 : r.reads - 1;
  const int taken = r.steps_taken(e);
  for (int t = r.steps; t >= 0; --t) {
    const std::size_t row = r.row(t, e);
    const StateView<T> now = r.state(m, t, e);
    gradient.q += to_tangent<T>(m, now.q, cotangent.q + row * m.nq);
    gradient.v += Eigen::Map<const VX<T>>(cotangent.v + row * m.nv, m.nv);
    readings_vjp<T>(m, params, t, e, r, cotangent, grad_params, gradient, read, memory.work);
    if (t == 0 || ends()) break;
    if (t > taken) continue;
    const T* u = r.controls(m, t - 1, e);
    T* grad_u = out.u + (u - r.u);
    record_substeps<T>(m, params, u, r.state(m, t - 1, e), now, r.halvings[r.row(t - 1, e)] != 0, memory, records);
    for (auto it = records.rbegin(); it != records.rend(); ++it) {
      substep_vjp<T>(m, params, u, *it, gradient, grad_u, memory, [&](const VX<T>& multiplier) {
        if (grad_params == nullptr) return;
        const ParamState at{
            it->beta_h, it->q0.data(),      it->v_star.data(),  it->bdf2 ? it->history.data() : nullptr, it->v1.data(),
            u,          it->anchors.data(), it->anchored.data()};
        add_step_param_gradient(m, params, at, multiplier.data(), gradient.anchors.data(), grad_params);
      });
    }
  }
  if (r.active[e] != 0) follow_leaders_vjp<T>(m, gradient);
  add_from_tangent<T>(m, r.q + e * m.nq, gradient.q, out.q + e * m.nq);
  std::copy_n(gradient.v.data(), m.nv, out.v + e * m.nv);
  std::copy_n(gradient.anchors.data(), m.na, reinterpret_cast<V3<T>*>(out.anchors) + e * m.na);
  std::copy_n(gradient.history.data(), m.nh, out.history + e * m.nh);
}

}  // namespace gelflow
