// The members of Batch, compiled once per precision: batch_double.cpp, batch_float.cpp.
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
  check_controls(u.numbers, u.alike ? 1 : n);
  check_state();
  const std::size_t apart = u.alike ? 0 : model->actuators.size();
  pool_.run(n, [&](int e, int thread) {
    for (int i = 0; i < steps && status[e] == 0; ++i) {
      const StepReport report = gelflow::step<T>(*model, params_of(e), u.numbers + static_cast<std::size_t>(e) * apart,
                                                 model->polish, state(e), memory_[thread], i > 0);
      status[e] = static_cast<std::int32_t>(report.status);
      iterations[e] += report.iterations;
      halved[e] += report.halvings > 0 ? 1 : 0;
    }
  });
}

template <class T>
void Batch<T>::error_estimate(const Controls<T>& u, T* out, std::int32_t* failures) {
  check_controls(u.numbers, u.alike ? 1 : n);
  check_state();
  const Model& m = *model;
  const std::size_t apart = u.alike ? 0 : m.actuators.size();
  pool_.run(n, [&](int e, int thread) {
    StepMemory<T>& memory = memory_[thread];
    const T* const control = u.numbers + static_cast<std::size_t>(e) * apart;
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
    if (status != Status::ok) return;
    for (const Joint& joint : m.joints) {
      for (int a = 0; a < joint.scalar_dofs(); ++a) {
        difference[joint.v + a] = whole.q[joint.q + a] - halves.q[joint.q + a];
      }
      if (!joint.has_quaternion()) continue;
      V4<T> back = vec4(halves.q.data() + joint.quaternion_q());
      back.template tail<3>() *= T(-1);
      const V4<T> turn = quaternion_product<T>(back, vec4(whole.q.data() + joint.quaternion_q()));
      const T sine = turn.template tail<3>().norm();  // a step turns by far less than half a turn
      const T scale = sine > T(1e-12) ? T(2) * std::atan2(sine, turn[0]) / sine : T(2);
      for (int a = 0; a < 3; ++a) difference[joint.angular_v() + a] = scale * turn[1 + a];
    }
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
void Batch<T>::tactile() {
  if (dirty_.empty()) {
    readings.resize(static_cast<std::size_t>(n) * model->markers * 3);
    dirty_.resize(n);
  }
  read(readings.data(), dirty_.data());
}

template <class T>
void Batch<T>::read(T* out, DirtyMarkers* dirty) {
  pool_.run(n, [&](int e, int thread) {
    const StateView<T> s = state(e);
    Workspace<T>& w = memory_[thread].work;
    forward_state<false, T>(*model, params_of(e), s.q, s.q_rounding, s.v, w);
    read_markers<T>(*model, params_of(e), s.anchors, s.anchored, w,
                    out + static_cast<std::size_t>(e) * model->markers * 3, dirty == nullptr ? nullptr : dirty + e);
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
    const StepStart<T> from{T(1), nullptr, nullptr, nullptr, nullptr, state(e).anchors, state(e).anchored, nullptr};
    subtract_contact_forces<false, T>(*model, params_of(e), from, CacheState::stale, false, w);
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
      for (int k = joint.v; k < joint.v + joint.dofs; ++k) w.mass(k, k) += params_of(e)[joint.param + 1];
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

template <class T>
void Batch<T>::rollout(const Rollout<T>& r) {
  const Model& m = *model;
  const std::size_t nu = m.actuators.size(), na = m.na, N = n;
  check_controls(r.u, r.steps * n);
  pool_.run(n, [&](int env, int thread) {
    const std::size_t e = env;
    StepMemory<T>& memory = memory_[thread];
    r.status[e] = 0;
    int read = 0;
    VX<T> q_rounding = VX<T>::Zero(std::is_same_v<T, PositionScalar<T>> ? 0 : m.nq);  // goes along with the last state
    const auto at = [&](int t) {
      const std::size_t row = t * N + e;
      return StateView<T>{
          r.q + row * m.nq,      r.v + row * m.nv,       reinterpret_cast<V3<T>*>(r.anchors) + row * na,
          r.anchored + row * na, r.history + row * m.nh, q_rounding.size() == 0 ? nullptr : q_rounding.data()};
    };
    for (int t = 0;; ++t) {
      const StateView<T> now = at(t);
      for (; read < r.reads && r.read_after[read] == t; ++read) {
        forward_state<false, T>(m, params_of(env), now.q, now.q_rounding, now.v, memory.work);
        read_markers<T>(m, params_of(env), now.anchors, now.anchored, memory.work,
                        r.tactile + (read * N + e) * m.markers * 3, nullptr);
      }
      if (t == r.steps) break;
      const StateView<T> next = at(t + 1);
      std::copy(now.q, now.q + m.nq, next.q);
      std::copy(now.v, now.v + m.nv, next.v);
      std::copy(now.anchored, now.anchored + na, next.anchored);
      for_each_set(now.anchored, m.na, [&](int i) { next.anchors[i] = now.anchors[i]; });
      std::copy(now.history, now.history + m.nh, next.history);
      if (r.status[e] != 0) continue;
      const StepReport report =
          gelflow::step<T>(m, params_of(env), r.u + (t * N + e) * nu, m.polish, next, memory, t > 0);
      r.status[e] = static_cast<std::int32_t>(report.status);
      r.halvings[t * N + e] = static_cast<std::int8_t>(report.halvings);
    }
  });
}

template <class T>
void Batch<T>::branches(const Rollout<T>& r, std::uint64_t* out) {
  const Model& m = *model;
  const std::size_t N = n;
  pool_.run(n, [&](int env, int thread) {
    const std::size_t e = env;
    for (int t = 0; t < r.steps; ++t) {
      const std::size_t before = t * N + e, after = before + N;
      const bool read = std::find(r.read_after, r.read_after + r.reads, t + 1) != r.read_after + r.reads;
      ModeHash hash;
      hash.add(contact_mode_signature<T>(m, params_of(env), r.q + after * m.nq, r.v + after * m.nv,
                                         reinterpret_cast<const V3<T>*>(r.anchors) + before * m.na,
                                         r.anchored + before * m.na, r.u + before * m.actuators.size(), read,
                                         memory_[thread].work));
      hash.add(static_cast<std::uint64_t>(r.halvings[before]));
      out[before] = hash.value();
    }
  });
}

template <class T>
void Batch<T>::rollout_transposed(const Rollout<T>& r, const RolloutGradient<T>& g) {
  const std::size_t N = n;
  if constexpr (std::is_same_v<T, double>) {
    std::fill_n(g.u, static_cast<std::size_t>(r.steps) * N * model->actuators.size(), 0.0);
    std::fill_n(g.q0, N * model->nq, 0.0);
    std::fill_n(g.v0, N * model->nv, 0.0);
    std::fill_n(g.anchors0, N * model->na * 3, 0.0);
    std::fill_n(g.history0, N * model->nh, 0.0);
    if (g.params) std::fill_n(g.params, N * model->param_names.size(), 0.0);
    pool_.run(n, [&](int e, int thread) {  // a failed environment has gradient zero
      if (r.status[e] == 0) transpose_one<T>(*model, params_of(e), e, N, r, g, memory_[thread]);
    });
  } else {
    // In double precision, at the states that were reached in single: rounding errors would add up on the way back. Not
    // so in readings without a memory, each of which speaks of its own state alone: they come in single precision.
    if (!exact_) exact_ = std::make_unique<Batch<double>>(model, n, threads());
    const Model& m = *model;
    std::copy(params.begin(), params.end(), exact_->params.begin());
    const std::size_t rows = static_cast<std::size_t>(r.steps + 1) * N, nu = m.actuators.size();
    const bool apart = m.na == 0 && g.params == nullptr;
    const int reads = apart ? 0 : r.reads;
    const auto exact = [](const T* values, std::size_t count) { return std::vector<double>(values, values + count); };
    const auto u = exact(r.u, (rows - N) * nu);
    auto q = exact(r.q, rows * m.nq), v = exact(r.v, rows * m.nv);
    auto anchors = exact(r.anchors, rows * m.na * 3), history = exact(r.history, rows * m.nh);
    auto by_q = exact(g.q, rows * m.nq), by_v = exact(g.v, rows * m.nv);
    const auto by_anchors = exact(g.anchors_end, N * m.na * 3);
    const auto by_history = exact(g.history_end, N * m.nh);
    const auto by_tactile = exact(g.tactile, static_cast<std::size_t>(reads) * N * m.markers * 3);
    pool_.run(apart ? n : 0, [&](int e, int thread) {
      for (int read = 0; read < r.reads && r.status[e] == 0; ++read) {
        const std::size_t row = r.read_after[read] * N + e;
        const StateView<T> now{r.q + row * m.nq, r.v + row * m.nv, nullptr, nullptr, nullptr};
        StateGradient<T> share(m);
        tactile_vjp<T>(m, params_of(e), now, g.tactile + (read * N + e) * m.markers * 3, share, memory_[thread].work);
        add_from_tangent<double>(m, q.data() + row * m.nq, share.q.template cast<double>(), by_q.data() + row * m.nq);
        for (int k = 0; k < m.nv; ++k) by_v[row * m.nv + k] += share.v[k];
      }
    });
    std::vector<double> by_u(u.size()), by_q0(N * m.nq), by_v0(N * m.nv), by_anchors0(by_anchors.size());
    std::vector<double> by_history0(by_history.size());
    exact_->rollout_transposed(
        {r.steps, reads, u.data(), q.data(), v.data(), anchors.data(), history.data(), r.anchored, r.halvings, r.status,
         r.read_after, nullptr},
        {by_q.data(), by_v.data(), by_anchors.data(), by_history.data(), by_tactile.data(), by_u.data(), by_q0.data(),
         by_v0.data(), by_anchors0.data(), by_history0.data(), g.params});
    std::copy(by_u.begin(), by_u.end(), g.u);
    std::copy(by_q0.begin(), by_q0.end(), g.q0);
    std::copy(by_v0.begin(), by_v0.end(), g.v0);
    std::copy(by_anchors0.begin(), by_anchors0.end(), g.anchors0);
    std::copy(by_history0.begin(), by_history0.end(), g.history0);
  }
}

}  // namespace gelflow
