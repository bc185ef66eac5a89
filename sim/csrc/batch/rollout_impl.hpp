// The members of Batch for rollouts and their reverse pass.
#pragma once

#include "batch/batch_impl.hpp"
#include "contact/contact_modes.hpp"

namespace gelflow {

// Copies one state to the next row; of the anchors only those that are set.
template <class T>
void copy_state(const Model& m, const StateView<T>& from, const StateView<T>& to) {
  std::copy_n(from.q, m.nq, to.q);
  std::copy_n(from.v, m.nv, to.v);
  std::copy_n(from.anchored, m.na, to.anchored);
  const V3<T>* const source = from.anchors;
  V3<T>* const target = to.anchors;
  for_each_set(from.anchored, m.na, [=](int i) { target[i] = source[i]; });
  std::copy_n(from.history, m.nh, to.history);
}

template <class T>
void Batch<T>::rollout_one(const Trajectory<T>& r, const TouchStop* stop, int env, int thread) {
  const Model& m = *model;
  const std::size_t e = env;
  StepMemory<T>& memory = memory_[thread];
  RolloutReadings<T> readings(m, params_of(env), r, stop, e, memory, reading_memory_[thread]);
  VX<T> rounding = VX<T>::Zero(std::is_same_v<T, PositionScalar<T>> ? 0 : m.nq);  // of q in the last state
  T* const q_rounding = rounding.size() == 0 ? nullptr : rounding.data();
  bool moving = true;
  follow_leaders<T>(m, r.state(m, 0, e, q_rounding));
  for (int t = 0;; ++t) {
    const StateView<T> now = r.state(m, t, e, q_rounding);
    if (readings.read(t, now, moving) && moving) {
      r.stopped_at[e] = t;
      moving = false;
    }
    if (t == r.steps || interruption_->check(thread)) break;
    const StateView<T> next = r.state(m, t + 1, e, q_rounding);
    if (!r.end_only) copy_state<T>(m, now, next);
    if (!moving) continue;
    const StepReport report = gelflow::step<T>(m, params_of(env), r.controls(m, t, e), m.polish, next, memory, t > 0);
    r.status[e] = static_cast<std::int32_t>(report.status);
    r.halvings[r.row(t, e)] = static_cast<std::int8_t>(report.halvings);
    moving = report.status == Status::ok;
  }
}

template <class T>
void Batch<T>::rollout(const Trajectory<T>& r, const TouchStop* stop) {
  check_controls(r.u, r.steps * n, r.active);
  check_state(r.q, r.v, r.active);
  check_anchors(reinterpret_cast<const V3<T>*>(r.anchors), r.anchored, r.active);
  check_history(r.history, r.active);
  check_params(r.active);
  for (int e = 0; e < n; ++e) {
    r.status[e] = 0;
    r.stopped_at[e] = -1;
    if (r.active[e] != 0 || r.end_only) continue;
    for (int t = 0; t < r.steps; ++t) copy_state<T>(*model, r.state(*model, t, e), r.state(*model, t + 1, e));
  }
  for_active(r.active, [&](int env, int thread) { rollout_one(r, stop, env, thread); });
}

template <class T>
void Batch<T>::contact_modes(const Trajectory<T>& r, std::uint64_t* out) {
  const Model& m = *model;
  std::fill_n(out, r.row(r.steps, 0), 0);
  for_all([&](int env, int thread) {
    const std::size_t e = env;
    const int taken = std::min(r.steps, r.steps_taken(e));  // a part of a trajectory may end before its stop
    for (int t = 0; t < taken && !interruption_->check(thread); ++t) {
      const bool read = std::find(r.read_after, r.read_after + r.reads, t + 1) != r.read_after + r.reads;
      const StateView<T> before = r.state(m, t, e), after = r.state(m, t + 1, e);
      ModeHash hash;
      hash.add(contact_mode_signature<T>(m, params_of(env), after.q, after.v, before.anchors, before.anchored,
                                         r.controls(m, t, e), read, memory_[thread].work));
      hash.add(static_cast<std::uint64_t>(r.halvings[r.row(t, e)]));
      out[r.row(t, e)] = hash.value();
    }
  });
}

// Double-precision copies of a trajectory and its cotangent, and memory for the gradient.
template <class T>
struct DoubleTrajectory {
  std::vector<double> u, q, v, anchors, history;
  std::vector<double> grad_q, grad_v, grad_anchors_end, grad_history_end, grad_tactile;
  std::vector<double> grad_u, grad_q0, grad_v0, grad_anchors0, grad_history0;
  Trajectory<double> trajectory{};

  DoubleTrajectory(const Model& m, const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent, int reads)
      : grad_q0(r.row(1, 0) * m.nq), grad_v0(r.row(1, 0) * m.nv) {
    const std::size_t n = r.environments, rows = r.row(r.steps + 1, 0), nu = m.actuators.size();
    const auto copy = [](const T* values, std::size_t count) { return std::vector<double>(values, values + count); };
    u = copy(r.u, (rows - n) * nu);
    q = copy(r.q, rows * m.nq);
    v = copy(r.v, rows * m.nv);
    anchors = copy(r.anchors, rows * m.na * 3);
    history = copy(r.history, rows * m.nh);
    grad_q = copy(cotangent.q, rows * m.nq);
    grad_v = copy(cotangent.v, rows * m.nv);
    grad_anchors_end = copy(cotangent.anchors_end, n * m.na * 3);
    grad_history_end = copy(cotangent.history_end, n * m.nh);
    grad_tactile = copy(cotangent.tactile, r.row(reads, 0) * r.reading_size(m));
    grad_u.resize(u.size());
    grad_anchors0.resize(grad_anchors_end.size());
    grad_history0.resize(grad_history_end.size());
    trajectory.steps = r.steps;
    trajectory.reads = reads;
    trajectory.environments = r.environments;
    trajectory.u = u.data();
    trajectory.q = q.data();
    trajectory.v = v.data();
    trajectory.anchors = anchors.data();
    trajectory.history = history.data();
    trajectory.anchored = r.anchored;
    trajectory.halvings = r.halvings;
    trajectory.status = r.status;
    trajectory.active = r.active;
    trajectory.stopped_at = r.stopped_at;
    trajectory.read_after = r.read_after;
    trajectory.reduction = r.reduction;
  }
  TrajectoryCotangent<double> cotangent() const {
    return {grad_q.data(), grad_v.data(), grad_anchors_end.data(), grad_history_end.data(), grad_tactile.data()};
  }
  TrajectoryGradient<double> gradient(double* grad_params) {
    return {grad_u.data(), grad_q0.data(), grad_v0.data(), grad_anchors0.data(), grad_history0.data(), grad_params};
  }
  void copy_gradient(const TrajectoryGradient<T>& out) const {
    std::copy(grad_u.begin(), grad_u.end(), out.u);
    std::copy(grad_q0.begin(), grad_q0.end(), out.q);
    std::copy(grad_v0.begin(), grad_v0.end(), out.v);
    std::copy(grad_anchors0.begin(), grad_anchors0.end(), out.anchors);
    std::copy(grad_history0.begin(), grad_history0.end(), out.history);
  }
};

// Adds the gradient through all marker readings to grad_q and grad_v, shaped as in the trajectory. For models without
// anchors, whose readings depend on the state alone.
template <class T>
void Batch<T>::add_readings_vjp(const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent, double* grad_q,
                                double* grad_v) {
  const Model& m = *model;
  for_active(r.active, [&](int e, int thread) {
    std::vector<T> forces;
    for (int read = 0; read < r.reads && r.status[e] == 0; ++read) {
      const int t = r.read_after[read];
      const StateView<T> now = r.state(m, t, e);
      StateGradient<T> gradient(m);
      const T* const grad_reading = grad_marker_forces(m, r, cotangent, read, e, forces);
      tactile_vjp<T>(m, params_of(e), now, grad_reading, gradient, memory_[thread].work);
      const VX<double> q = Eigen::Map<const VX<T>>(now.q, m.nq).template cast<double>();
      add_from_tangent<double>(m, q.data(), gradient.q.template cast<double>(), grad_q + r.row(t, e) * m.nq);
      for (int k = 0; k < m.nv; ++k) grad_v[r.row(t, e) * m.nv + k] += gradient.v[k];
    }
  });
}

template <class T>
void Batch<T>::rollout_vjp(const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent,
                           const TrajectoryGradient<T>& out) {
  const Model& m = *model;
  if constexpr (std::is_same_v<T, double>) {
    const std::size_t N = n;
    std::fill_n(out.u, r.row(r.steps, 0) * m.actuators.size(), 0.0);
    std::fill_n(out.q, N * m.nq, 0.0);
    std::fill_n(out.v, N * m.nv, 0.0);
    std::fill_n(out.anchors, N * m.na * 3, 0.0);
    std::fill_n(out.history, N * m.nh, 0.0);
    if (out.params) std::fill_n(out.params, N * m.param_names.size(), 0.0);
    for_all([&](int e, int thread) {
      if (r.status[e] != 0) return;
      const auto ends = [&] { return interruption_->check(thread); };
      gelflow::rollout_vjp<T>(m, params_of(e), e, r, cotangent, out, memory_[thread], ends);
    });
  } else {
    // Computed in double precision at the states of the single-precision trajectory, because rounding errors grow on the
    // way back. Readings that depend on one state only do not need it: their gradient is computed in single precision.
    if (!double_batch_) {
      double_batch_ = std::make_unique<Batch<double>>(model, n, threads());
      double_batch_->interruption_ = interruption_;
    }
    std::copy(params.begin(), params.end(), double_batch_->params.begin());
    const bool separate_readings = m.na == 0 && out.params == nullptr;
    DoubleTrajectory<T> doubles(m, r, cotangent, separate_readings ? 0 : r.reads);
    if (separate_readings) add_readings_vjp(r, cotangent, doubles.grad_q.data(), doubles.grad_v.data());
    double_batch_->rollout_vjp(doubles.trajectory, doubles.cotangent(), doubles.gradient(out.params));
    doubles.copy_gradient(out);
  }
}

}  // namespace gelflow
