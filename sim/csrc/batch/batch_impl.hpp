// Members of Batch. batch_double.cpp and batch_float.cpp compile them once per precision.
#pragma once

#include <stdexcept>

#include "batch/batch.hpp"
#include "contact/contact_modes.hpp"

namespace gelflow {

template <class T>
Batch<T>::Batch(std::shared_ptr<const Model> m, int environments, int threads)
    : model(std::move(m)),
      n(environments),
      q(static_cast<std::size_t>(n) * model->nq),
      v(static_cast<std::size_t>(n) * model->nv),
      params(static_cast<std::size_t>(n) * model->param_names.size()),
      anchors(static_cast<std::size_t>(n) * model->na, V3<T>::Zero()),
      anchored(static_cast<std::size_t>(n) * model->na),
      history(static_cast<std::size_t>(n) * model->nh),
      status(n),
      iterations(n),
      halved(n),
      pool_(threads) {
  if (!std::is_same_v<T, PositionScalar<T>>) q_rounding_.resize(q.size());
  for (int i = 0; i < pool_.size(); ++i) memory_.emplace_back(*model);
  for (int e = 0; e < n; ++e) {
    std::copy(model->param_defaults.begin(), model->param_defaults.end(),
              params.begin() + static_cast<std::ptrdiff_t>(e * model->param_names.size()));
  }
  reset(nullptr);
}

template <class T>
StateView<T> Batch<T>::state(int env) {
  const auto e = static_cast<std::size_t>(env);
  return {q.data() + e * model->nq,       v.data() + e * model->nv,
          anchors.data() + e * model->na, anchored.data() + e * model->na,
          history.data() + e * model->nh, q_rounding_.empty() ? nullptr : q_rounding_.data() + e * model->nq};
}

template <class T>
void Batch<T>::reset(const std::uint8_t* which) {
  for (int e = 0; e < n; ++e) {
    if (which && !which[e]) continue;
    const StateView<T> s = state(e);
    std::copy(model->q0.begin(), model->q0.end(), s.q);
    if (s.q_rounding != nullptr) std::fill_n(s.q_rounding, model->nq, T(0));
    std::fill(s.v, s.v + model->nv, T(0));
    std::fill(s.anchored, s.anchored + model->na, 0);
    std::fill(s.anchors, s.anchors + model->na, V3<T>::Zero());
    std::fill(s.history, s.history + model->nh, T(0));
    status[e] = 0;
    iterations[e] = halved[e] = 0;
  }
}

template <class T>
void Batch<T>::check_controls(const T* u, int rows) const {
  const int nu = static_cast<int>(model->actuators.size());
  for (std::ptrdiff_t i = 0; i < static_cast<std::ptrdiff_t>(rows) * nu; ++i) {
    if (is_finite(u[i])) continue;
    throw std::invalid_argument("control of actuator '" + model->actuators[i % nu].name + "' in environment " +
                                std::to_string(i / nu % n) + " is not finite");
  }
}

template <class T>
void Batch<T>::check_state() const {
  const auto check = [&](const std::vector<T>& values, const char* what, int width) {
    for (std::size_t i = 0; i < values.size(); ++i) {
      if (is_finite(values[i])) continue;
      throw std::invalid_argument(std::string(what) + "[" + std::to_string(i / width) + ", " +
                                  std::to_string(i % width) + "] is not finite");
    }
  };
  check(q, "q", model->nq);
  check(v, "v", model->nv);
}

template <class T>
void Batch<T>::step(const Controls<T>& u, int steps) {
  check_controls(u.u, u.shared ? 1 : n);
  check_state();
  pool_.run(n, [&](int e, int thread) {
    for (int i = 0; i < steps && status[e] == 0; ++i) {
      const StepReport report =
          gelflow::step<T>(*model, params_of(e), controls_of(u, e), model->polish, state(e), memory_[thread], i > 0);
      status[e] = static_cast<std::int32_t>(report.status);
      iterations[e] += report.iterations;
      halved[e] += report.halvings > 0 ? 1 : 0;
    }
  });
}

// The tangent vector from positions q0 to positions q1 that are less than half a turn away: q1 ⊖ q0.
template <class T>
void position_difference(const Model& m, const T* q0, const T* q1, T* out) {
  for (const Joint& joint : m.joints) {
    for (int a = 0; a < joint.scalar_dofs(); ++a) out[joint.v + a] = q1[joint.q + a] - q0[joint.q + a];
    if (!joint.has_quaternion()) continue;
    V4<T> conjugate = vec4(q0 + joint.quaternion_q());
    conjugate.template tail<3>() *= T(-1);
    const V4<T> rotation = quaternion_product<T>(conjugate, vec4(q1 + joint.quaternion_q()));
    const T sine = rotation.template tail<3>().norm();
    const T scale = sine > T(1e-12) ? T(2) * std::atan2(sine, rotation[0]) / sine : T(2);
    for (int a = 0; a < 3; ++a) out[joint.angular_v() + a] = scale * rotation[1 + a];
  }
}

template <class T>
void Batch<T>::error_estimate(const Controls<T>& u, T* out, std::int32_t* failures) {
  check_controls(u.u, u.shared ? 1 : n);
  check_state();
  const Model& m = *model;
  pool_.run(n, [&](int e, int thread) {
    StepMemory<T>& memory = memory_[thread];
    const T* const control = controls_of(u, e);
    StateCopy<T> whole(m, state(e)), halves(m, state(e));
    const StepReport taken = gelflow::step<T>(m, params_of(e), control, m.polish, whole.view(), memory, false);
    Status status = taken.status;
    const int parts = 2 << taken.halvings;  // each half of the shortest substep
    for (int i = 0; i < parts && status == Status::ok; ++i) {
      status = gelflow::step<T>(m, params_of(e), control, m.polish, halves.view(), memory, i > 0, NoObserver{}, parts)
                   .status;
    }
    failures[e] = static_cast<std::int32_t>(status);
    T* const difference = out + static_cast<std::size_t>(e) * m.nv;
    std::fill_n(difference, m.nv, T(0));
    if (status == Status::ok) position_difference<T>(m, halves.q.data(), whole.q.data(), difference);
  });
}

template <class T>
void Batch<T>::kinematics(int env, Workspace<T>& w) {
  const StateView<T> s = state(env);
  forward_state<true, T>(*model, params_of(env), s.q, s.q_rounding, s.v, w);
}

template <class T>
void Batch<T>::tactile(T* out) {
  read(out, nullptr);
}

template <class T>
void Batch<T>::update_readings() {
  if (nonzero_.empty()) {
    readings.resize(static_cast<std::size_t>(n) * model->num_markers * 3);
    nonzero_.resize(n);
  }
  read(readings.data(), nonzero_.data());
}

template <class T>
void Batch<T>::read(T* out, NonzeroMarkers* nonzero) {
  pool_.run(n, [&](int e, int thread) {
    const StateView<T> s = state(e);
    Workspace<T>& w = memory_[thread].work;
    forward_state<false, T>(*model, params_of(e), s.q, s.q_rounding, s.v, w);
    read_markers<T>(*model, params_of(e), s.anchors, s.anchored, w,
                    out + static_cast<std::size_t>(e) * model->num_markers * 3,
                    nonzero == nullptr ? nullptr : nonzero + e);
  });
}

template <class T>
void Batch<T>::wrenches(T* out) {
  pool_.run(n, [&](int e, int thread) {
    kinematics(e, memory_[thread].work);
    contact_wrenches<T>(*model, params_of(e), state(e).anchors, state(e).anchored, memory_[thread].work,
                        out + static_cast<std::size_t>(e) * model->contacts.size() * 6);
  });
}

template <class T>
void Batch<T>::contact_forces(T* out) {
  pool_.run(n, [&](int e, int thread) {
    Workspace<T>& w = memory_[thread].work;
    kinematics(e, w);
    w.residual.setZero();
    const StepStart<T> start{T(1), nullptr, nullptr, nullptr, nullptr, state(e).anchors, state(e).anchored, nullptr};
    subtract_contact_forces<false, T>(*model, params_of(e), start, CacheState::stale, false, w);
    for (int k = 0; k < model->nv; ++k) out[static_cast<std::size_t>(e) * model->nv + k] = -w.residual[k];
  });
}

template <class T>
void Batch<T>::poses(T* out) {
  Workspace<T>& w = memory_[0].work;
  for (int e = 0; e < n; ++e) {
    kinematics(e, w);
    for (std::size_t b = 0; b < model->bodies.size(); ++b, out += 7) {
      const Eigen::Quaternion<PositionScalar<T>> turn(w.rotation[b]);
      for (int i = 0; i < 3; ++i) out[i] = T(w.position[b][i]);
      out[3] = T(turn.w());
      out[4] = T(turn.x());
      out[5] = T(turn.y());
      out[6] = T(turn.z());
    }
  }
}

template <class T>
void Batch<T>::mass_matrix(T* out) {
  Workspace<T>& w = memory_[0].work;
  const std::size_t size = static_cast<std::size_t>(model->nv) * model->nv;
  for (int e = 0; e < n; ++e, out += size) {
    kinematics(e, w);
    w.residual.setZero();
    w.by_q.setZero();
    w.by_v.setZero();
    add_inverse_dynamics<true, T>(*model, params_of(e), T(1), state(e).v, nullptr, w);
    for (const Joint& joint : model->joints) {
      for (int k = joint.v; k < joint.v + joint.dofs; ++k) w.mass(k, k) += joint.params.in(params_of(e)).armature;
    }
    for (int k = 0; k < model->nv; ++k) std::copy_n(&w.mass(k, 0), model->nv, out + k * model->nv);
  }
}

template <class T>
void Batch<T>::bias(T* out) {
  Workspace<T>& w = memory_[0].work;
  for (int e = 0; e < n; ++e, out += model->nv) {
    kinematics(e, w);
    w.residual.setZero();
    add_inverse_dynamics<false, T>(*model, params_of(e), T(1), state(e).v, nullptr, w);
    std::copy_n(w.residual.data(), model->nv, out);
  }
}

// Copies one state to the next row; of the anchors only those that are set.
template <class T>
void copy_state(const Model& m, const StateView<T>& from, const StateView<T>& to) {
  std::copy_n(from.q, m.nq, to.q);
  std::copy_n(from.v, m.nv, to.v);
  std::copy_n(from.anchored, m.na, to.anchored);
  for_each_set(from.anchored, m.na, [&](int i) { to.anchors[i] = from.anchors[i]; });
  std::copy_n(from.history, m.nh, to.history);
}

template <class T>
void Batch<T>::rollout_one(const Trajectory<T>& r, int env, StepMemory<T>& memory) {
  const Model& m = *model;
  const std::size_t e = env;
  r.status[e] = 0;
  int read = 0;
  VX<T> rounding = VX<T>::Zero(std::is_same_v<T, PositionScalar<T>> ? 0 : m.nq);  // of q in the last state
  T* const q_rounding = rounding.size() == 0 ? nullptr : rounding.data();
  for (int t = 0;; ++t) {
    const StateView<T> now = r.state(m, t, e, q_rounding);
    for (; read < r.reads && r.read_after[read] == t; ++read) {
      forward_state<false, T>(m, params_of(env), now.q, now.q_rounding, now.v, memory.work);
      read_markers<T>(m, params_of(env), now.anchors, now.anchored, memory.work, r.tactile + r.reading(m, read, e),
                      nullptr);
    }
    if (t == r.steps) break;
    const StateView<T> next = r.state(m, t + 1, e, q_rounding);
    copy_state<T>(m, now, next);
    if (r.status[e] != 0) continue;
    const StepReport report = gelflow::step<T>(m, params_of(env), r.controls(m, t, e), m.polish, next, memory, t > 0);
    r.status[e] = static_cast<std::int32_t>(report.status);
    r.halvings[r.row(t, e)] = static_cast<std::int8_t>(report.halvings);
  }
}

template <class T>
void Batch<T>::rollout(const Trajectory<T>& r) {
  check_controls(r.u, r.steps * n);
  pool_.run(n, [&](int env, int thread) { rollout_one(r, env, memory_[thread]); });
}

template <class T>
void Batch<T>::contact_modes(const Trajectory<T>& r, std::uint64_t* out) {
  const Model& m = *model;
  pool_.run(n, [&](int env, int thread) {
    const std::size_t e = env;
    for (int t = 0; t < r.steps; ++t) {
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
  std::vector<double> by_q, by_v, by_anchors_end, by_history_end, by_tactile;
  std::vector<double> by_u, by_q0, by_v0, by_anchors0, by_history0;
  Trajectory<double> trajectory;

  DoubleTrajectory(const Model& m, const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent, int reads)
      : by_q0(r.row(1, 0) * m.nq), by_v0(r.row(1, 0) * m.nv) {
    const std::size_t n = r.environments, rows = r.row(r.steps + 1, 0), nu = m.actuators.size();
    const auto copy = [](const T* values, std::size_t count) { return std::vector<double>(values, values + count); };
    u = copy(r.u, (rows - n) * nu);
    q = copy(r.q, rows * m.nq);
    v = copy(r.v, rows * m.nv);
    anchors = copy(r.anchors, rows * m.na * 3);
    history = copy(r.history, rows * m.nh);
    by_q = copy(cotangent.q, rows * m.nq);
    by_v = copy(cotangent.v, rows * m.nv);
    by_anchors_end = copy(cotangent.anchors_end, n * m.na * 3);
    by_history_end = copy(cotangent.history_end, n * m.nh);
    by_tactile = copy(cotangent.tactile, r.row(reads, 0) * m.num_markers * 3);
    by_u.resize(u.size());
    by_anchors0.resize(by_anchors_end.size());
    by_history0.resize(by_history_end.size());
    trajectory = {r.steps,        reads,      r.environments, u.data(), q.data(),     v.data(), anchors.data(),
                  history.data(), r.anchored, r.halvings,     r.status, r.read_after, nullptr};
  }
  TrajectoryCotangent<double> cotangent() const {
    return {by_q.data(), by_v.data(), by_anchors_end.data(), by_history_end.data(), by_tactile.data()};
  }
  TrajectoryGradient<double> gradient(double* by_params) {
    return {by_u.data(), by_q0.data(), by_v0.data(), by_anchors0.data(), by_history0.data(), by_params};
  }
  void copy_gradient(const TrajectoryGradient<T>& out) const {
    std::copy(by_u.begin(), by_u.end(), out.u);
    std::copy(by_q0.begin(), by_q0.end(), out.q);
    std::copy(by_v0.begin(), by_v0.end(), out.v);
    std::copy(by_anchors0.begin(), by_anchors0.end(), out.anchors);
    std::copy(by_history0.begin(), by_history0.end(), out.history);
  }
};

// Adds the gradient through all marker readings to by_q and by_v, shaped as in the trajectory. For models without
// anchors, whose readings depend on the state alone.
template <class T>
void Batch<T>::add_readings_vjp(const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent, double* by_q,
                                double* by_v) {
  const Model& m = *model;
  pool_.run(n, [&](int e, int thread) {
    for (int read = 0; read < r.reads && r.status[e] == 0; ++read) {
      const int t = r.read_after[read];
      const StateView<T> now = r.state(m, t, e);
      StateGradient<T> gradient(m);
      tactile_vjp<T>(m, params_of(e), now, cotangent.tactile + r.reading(m, read, e), gradient, memory_[thread].work);
      const VX<double> q = Eigen::Map<const VX<T>>(now.q, m.nq).template cast<double>();
      add_from_tangent<double>(m, q.data(), gradient.q.template cast<double>(), by_q + r.row(t, e) * m.nq);
      for (int k = 0; k < m.nv; ++k) by_v[r.row(t, e) * m.nv + k] += gradient.v[k];
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
    pool_.run(n, [&](int e, int thread) {
      if (r.status[e] == 0) gelflow::rollout_vjp<T>(m, params_of(e), e, r, cotangent, out, memory_[thread]);
    });
  } else {
    // Computed in double precision at the states of the single-precision trajectory, because rounding errors grow on the
    // way back. Readings that depend on one state only do not need it: their gradient is computed in single precision.
    if (!double_batch_) double_batch_ = std::make_unique<Batch<double>>(model, n, threads());
    std::copy(params.begin(), params.end(), double_batch_->params.begin());
    const bool separate_readings = m.na == 0 && out.params == nullptr;
    DoubleTrajectory<T> doubles(m, r, cotangent, separate_readings ? 0 : r.reads);
    if (separate_readings) add_readings_vjp(r, cotangent, doubles.by_q.data(), doubles.by_v.data());
    double_batch_->rollout_vjp(doubles.trajectory, doubles.cotangent(), doubles.gradient(out.params));
    doubles.copy_gradient(out);
  }
}

}  // namespace gelflow
