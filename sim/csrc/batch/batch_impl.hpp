// Members of Batch. batch_double.cpp and batch_float.cpp compile them once per precision.
#pragma once

#include <cstring>
#include <stdexcept>

#include "batch/batch.hpp"
#include "dynamics/state_checks.hpp"

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
  reading_memory_.resize(pool_.size());
  for (int e = 0; e < n; ++e) {
    std::copy(model->param_defaults.begin(), model->param_defaults.end(),
              params.begin() + static_cast<std::ptrdiff_t>(e * model->param_names.size()));
  }
  checked_params_ = params;
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
void Batch<T>::for_active(const std::uint8_t* active, const std::function<void(int, int)>& work) {
  if (active == nullptr) return for_all(work);
  active_.clear();
  for (int e = 0; e < n; ++e) {
    if (active[e] != 0) active_.push_back(e);
  }
  pool_.run(static_cast<int>(active_.size()), [&](int i, int thread) { work(active_[i], thread); }, *interruption_);
}

template <class T>
void Batch<T>::check_controls(const T* u, int rows, const std::uint8_t* active) const {
  const int nu = static_cast<int>(model->actuators.size());
  for (std::ptrdiff_t i = 0; i < static_cast<std::ptrdiff_t>(rows) * nu; ++i) {
    if (is_finite(u[i])) continue;
    const auto env = static_cast<int>(i / nu % n);
    if (active != nullptr && active[env] == 0) continue;
    throw std::invalid_argument("control of actuator '" + model->actuators[i % nu].name + "' in environment " +
                                std::to_string(env) + " is not finite");
  }
}

template <class T>
void Batch<T>::check_state(const T* positions, const T* velocities, const std::uint8_t* active) const {
  check_finite(positions, "q", n, model->nq, active);
  check_finite(velocities, "v", n, model->nv, active);
  check_quaternions(*model, positions, n, active);
}

template <class T>
void Batch<T>::check_history(const T* histories, const std::uint8_t* active) const {
  const auto nh = static_cast<std::size_t>(model->nh);
  for (std::size_t i = 0; i < n * nh; ++i) {
    if (is_finite(histories[i]) || (active != nullptr && active[i / nh] == 0)) continue;
    throw std::invalid_argument("history[" + std::to_string(i / nh) + ", " + std::to_string(i % nh) +
                                "] is not finite");
  }
}

// Of a rollout only: for a single step or a reading this takes too long, and a step with such an anchor fails.
template <class T>
void Batch<T>::check_anchors(const V3<T>* values, const std::uint8_t* is_set, const std::uint8_t* active) const {
  const auto na = static_cast<std::size_t>(model->na);
  for (std::size_t i = 0; i < n * na; ++i) {
    if (is_set[i] == 0 || is_finite(values[i].sum()) || (active != nullptr && active[i / na] == 0)) continue;
    throw std::invalid_argument("anchors[" + std::to_string(i / na) + ", " + std::to_string(i % na) +
                                "] is not finite");
  }
}

template <class T>
void Batch<T>::check_all(const std::uint8_t* active) {
  check_state(q.data(), v.data(), active);
  check_history(history.data(), active);
  check_params(active);
}

// Compares parameters with those that were checked before, which costs less than a check.
template <class T>
void Batch<T>::check_params(const std::uint8_t* active) {
  const std::size_t width = model->param_names.size();
  for (int e = 0; checks_params && e < n; ++e) {
    T* const valid = checked_params_.data() + e * width;
    if (std::memcmp(valid, params_of(e), width * sizeof(T)) == 0 || (active != nullptr && active[e] == 0)) continue;
    const std::string wrong = wrong_parameter(*model, params_of(e));
    if (!wrong.empty()) throw std::invalid_argument("environment " + std::to_string(e) + ": " + wrong);
    std::copy_n(params_of(e), width, valid);
  }
}

template <class T>
void Batch<T>::step(const Controls<T>& u, int steps, const std::uint8_t* active) {
  if (steps < 0) throw std::invalid_argument("steps must not be negative, got " + std::to_string(steps));
  check_controls(u.u, u.shared ? 1 : n, u.shared ? nullptr : active);
  check_all(active);
  for_active(active, [&](int e, int thread) {
    follow_leaders<T>(*model, state(e));
    for (int i = 0; i < steps && status[e] == 0 && !interruption_->check(thread); ++i) {
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
  check_controls(u.u, u.shared ? 1 : n, nullptr);
  check_all(nullptr);
  const Model& m = *model;
  for_all([&](int e, int thread) {
    StepMemory<T>& memory = memory_[thread];
    const T* const control = controls_of(u, e);
    follow_leaders<T>(m, state(e));
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
  follow_leaders<T>(*model, s);
  forward_state<true, T>(*model, params_of(env), s.q, s.q_rounding, s.v, w);
}

template <class T>
void Batch<T>::tactile(T* out, const std::uint8_t* active) {
  read(out, nullptr, active);
}

template <class T>
void Batch<T>::reduced_tactile(const TactileReduction& reduction, T* out, const std::uint8_t* active) {
  check_all(active);
  for_active(active, [&](int e, int thread) {
    ReadingMemory<T>& memory = reading_memory_[thread];
    memory.forces.resize(static_cast<std::size_t>(model->num_markers) * 3);
    read_one(e, thread, memory.forces.data(), &memory.nonzero);
    reduction.apply(memory.forces.data(), memory.sums, out + static_cast<std::size_t>(e) * reduction.rows());
  });
}

template <class T>
void Batch<T>::update_readings(const std::uint8_t* active) {
  if (nonzero_.empty()) {
    readings.resize(static_cast<std::size_t>(n) * model->num_markers * 3);
    nonzero_.resize(n);
  }
  read(readings.data(), nonzero_.data(), active);
}

template <class T>
void Batch<T>::read(T* out, NonzeroMarkers* nonzero, const std::uint8_t* active) {
  check_all(active);
  for_active(active, [&](int e, int thread) {
    read_one(e, thread, out + static_cast<std::size_t>(e) * model->num_markers * 3,
             nonzero == nullptr ? nullptr : nonzero + e);
  });
}

template <class T>
void Batch<T>::read_one(int e, int thread, T* out, NonzeroMarkers* nonzero) {
  const StateView<T> s = state(e);
  Workspace<T>& w = memory_[thread].work;
  follow_leaders<T>(*model, s);
  forward_state<false, T>(*model, params_of(e), s.q, s.q_rounding, s.v, w);
  read_markers<T>(*model, params_of(e), s.anchors, s.anchored, w, out, nonzero);
}

template <class T>
void Batch<T>::wrenches(T* out) {
  check_all(nullptr);
  for_all([&](int e, int thread) {
    kinematics(e, memory_[thread].work);
    contact_wrenches<T>(*model, params_of(e), state(e).anchors, state(e).anchored, memory_[thread].work,
                        out + static_cast<std::size_t>(e) * model->contacts.size() * 6);
  });
  check_finite(out, "result of wrenches: w", n, static_cast<int>(model->contacts.size()) * 6, nullptr);
}

// Without the arc correction, which belongs to a step.
template <class T>
void Batch<T>::contact_forces(T* out) {
  check_all(nullptr);
  for_all([&](int e, int thread) {
    Workspace<T>& w = memory_[thread].work;
    kinematics(e, w);
    w.residual.setZero();
    std::vector<T> wrenches(6 * model->contacts.size());
    contact_wrenches<T>(*model, params_of(e), state(e).anchors, state(e).anchored, w, wrenches.data());
    for (std::size_t i = 0; i < model->contacts.size(); ++i) {
      const V6<T> wrench = Eigen::Map<const V6<T>>(wrenches.data() + 6 * i);
      subtract_impulses<T>(model->contacts[i].pair, T(1), wrench, false, w);
    }
    for (int k = 0; k < model->nv; ++k) out[static_cast<std::size_t>(e) * model->nv + k] = -w.residual[k];
  });
  check_finite(out, "result of contact_forces: f", n, model->nv, nullptr);
}

template <class T>
void Batch<T>::poses(T* out) {
  check_all(nullptr);
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
  check_all(nullptr);
  Workspace<T>& w = memory_[0].work;
  const std::size_t size = static_cast<std::size_t>(model->nv) * model->nv;
  T* const first = out;
  for (int e = 0; e < n; ++e, out += size) {
    kinematics(e, w);
    w.residual.setZero();
    find_coupled_islands<T>(*model, w);
    w.dg_dq.set_zero();
    w.dg_dv.set_zero();
    if (!model->tendons.empty()) w.mass.set_zero();
    add_inverse_dynamics<true, T>(*model, params_of(e), T(1), state(e).v, nullptr, w);
    add_tendon_mass<T>(*model, params_of(e), w);
    for (const Joint& joint : model->joints) {
      for (int k = joint.v; k < joint.v + joint.dofs; ++k)
        w.mass.in_tree(k, k) += joint.params.in(params_of(e)).armature;
    }
    std::fill_n(out, size, T(0));
    for (int i = 0; i < model->nv; ++i) {
      T* const row = out + static_cast<std::ptrdiff_t>(i) * model->nv;
      w.layout.for_dofs(w.layout.island_of(i), [&](int j) { row[j] = w.mass(i, j); });
    }
  }
  check_finite(first, "result of mass_matrix: m", n, static_cast<int>(size), nullptr);
}

template <class T>
void Batch<T>::bias(T* out) {
  check_all(nullptr);
  Workspace<T>& w = memory_[0].work;
  for (int e = 0; e < n; ++e) {
    kinematics(e, w);
    w.residual.setZero();
    add_inverse_dynamics<false, T>(*model, params_of(e), T(1), state(e).v, nullptr, w);
    std::copy_n(w.residual.data(), model->nv, out + static_cast<std::size_t>(e) * model->nv);
  }
  check_finite(out, "result of bias: c", n, model->nv, nullptr);
}

}  // namespace gelflow
