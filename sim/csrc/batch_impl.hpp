// The members of Batch, compiled once per precision: batch_double.cpp, batch_float.cpp.
#pragma once

#include <stdexcept>

#include "batch.hpp"
#include "branches.hpp"

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
  return {q.data() + e * model->nq, v.data() + e * model->nv, anchors.data() + e * model->na,
          anchored.data() + e * model->na, history.data() + e * model->nh};
}

template <class T>
void Batch<T>::reset(const std::uint8_t* which) {
  for (int e = 0; e < n; ++e) {
    if (which && !which[e]) continue;
    const StateView<T> s = state(e);
    std::copy(model->q0.begin(), model->q0.end(), s.q);
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
void Batch<T>::step(const T* u, int steps) {
  check_controls(u, n);
  check_state();
  const std::size_t nu = model->actuators.size();
  pool_.run(n, [&](int e, int thread) {
    for (int i = 0; i < steps && status[e] == 0; ++i) {
      const StepReport report = gelflow::step<T>(*model, params_of(e), u + static_cast<std::size_t>(e) * nu,
                                                 model->polish, state(e), memory_[thread], i > 0);
      status[e] = static_cast<std::int32_t>(report.status);
      iterations[e] += report.iterations;
      halved[e] += report.halvings > 0 ? 1 : 0;
    }
  });
}

template <class T>
void Batch<T>::error_estimate(const T* u, T* out, std::int32_t* failures) {
  check_controls(u, n);
  check_state();
  const Model& m = *model;
  const std::size_t nu = m.actuators.size();
  pool_.run(n, [&](int e, int thread) {
    StepMemory<T>& memory = memory_[thread];
    const T* const control = u + static_cast<std::size_t>(e) * nu;
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
      for (int a = 0; a < joint.plain(); ++a) {
        difference[joint.v + a] = whole.q[joint.q + a] - halves.q[joint.q + a];
      }
      if (!joint.turns()) continue;
      V4<T> back = vec4(halves.q.data() + joint.turn_q());
      back.template tail<3>() *= T(-1);
      const V4<T> turn = quaternion_product<T>(back, vec4(whole.q.data() + joint.turn_q()));
      const T sine = turn.template tail<3>().norm();  // a step turns by far less than half a turn
      const T scale = sine > T(1e-12) ? T(2) * std::atan2(sine, turn[0]) / sine : T(2);
      for (int a = 0; a < 3; ++a) difference[joint.turn_v() + a] = scale * turn[1 + a];
    }
  });
}

template <class T>
void Batch<T>::kinematics(int env, Workspace<T>& w) {
  const StateView<T> s = state(env);
  w.update.setZero();
  forward_positions<T>(*model, params_of(env), s.q, w);
  forward_velocities<true, T>(*model, params_of(env), s.v, w.update.data(), w);
}

template <class T>
void Batch<T>::tactile(T* out) {
  read(out, nullptr);
}

template <class T>
void Batch<T>::tactile() {
  if (written_.empty()) {
    readings.resize(static_cast<std::size_t>(n) * model->markers * 3);
    written_.resize(n);
  }
  read(readings.data(), written_.data());
}

template <class T>
void Batch<T>::read(T* out, Written* written) {
  pool_.run(n, [&](int e, int thread) {
    const StateView<T> s = state(e);
    Workspace<T>& w = memory_[thread].work;
    w.update.setZero();
    forward_positions<T>(*model, params_of(e), s.q, w);
    forward_velocities<false, T>(*model, params_of(e), s.v, w.update.data(), w);
    read_markers<T>(*model, params_of(e), s.anchors, s.anchored, w,
                    out + static_cast<std::size_t>(e) * model->markers * 3, written == nullptr ? nullptr : written + e);
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
    const StepStart<T> from{T(1), nullptr, nullptr, nullptr, state(e).anchors, state(e).anchored, nullptr};
    subtract_contact_forces<false, T>(*model, params_of(e), from, Found::elsewhere, false, w);
    for (int k = 0; k < model->nv; ++k) out[static_cast<std::size_t>(e) * model->nv + k] = -w.residual[k];
  });
}

template <class T>
void Batch<T>::poses(T* out) {
  Workspace<T>& w = memory_[0].work;
  for (int e = 0; e < n; ++e) {
    kinematics(e, w);
    for (std::size_t b = 0; b < model->bodies.size(); ++b, out += 7) {
      const Eigen::Quaternion<T> turn(w.rotation[b]);
      for (int i = 0; i < 3; ++i) out[i] = w.position[b][i];
      out[3] = turn.w();
      out[4] = turn.x();
      out[5] = turn.y();
      out[6] = turn.z();
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
    add_inverse_dynamics<true, T>(*model, params_of(e), T(1), state(e).v, w);
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
    add_inverse_dynamics<false, T>(*model, params_of(e), T(1), state(e).v, w);
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
    const auto at = [&](int t) {
      const std::size_t row = t * N + e;
      return StateView<T>{r.q + row * m.nq, r.v + row * m.nv, reinterpret_cast<V3<T>*>(r.anchors) + row * na,
                          r.anchored + row * na, r.history + row * m.nh};
    };
    for (int t = 0;; ++t) {
      const StateView<T> now = at(t);
      for (; read < r.reads && r.read_after[read] == t; ++read) {
        memory.work.update.setZero();
        forward_positions<T>(m, params_of(env), now.q, memory.work);
        forward_velocities<false, T>(m, params_of(env), now.v, memory.work.update.data(), memory.work);
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
      Signature hash;
      hash.add(branch_signature<T>(m, params_of(env), r.q + after * m.nq, r.v + after * m.nv,
                                   reinterpret_cast<const V3<T>*>(r.anchors) + before * m.na,
                                   r.anchored + before * m.na, r.u + before * m.actuators.size(), read,
                                   memory_[thread].work));
      hash.add(static_cast<std::uint64_t>(r.halvings[before]));
      out[before] = hash.value();
    }
  });
}

// What the gradients by parameters are asked with: everything in double precision.
template <class From>
std::vector<double> in_double(const From* values, std::size_t count) {
  return {values, values + count};
}
template <class T>
std::vector<V3<double>> in_double(const V3<T>* values, std::size_t count) {
  std::vector<V3<double>> result;
  for (std::size_t i = 0; i < count; ++i) result.push_back(values[i].template cast<double>());
  return result;
}
template <class T>
struct StepInDouble {
  StepInDouble(const Model& m, const T* numbers, const T* control, const Record<T>& r, const VX<T>& multipliers,
               const StateGradient<T>& g)
      : params(in_double(numbers, m.param_names.size())),
        u(in_double(control, m.actuators.size())),
        q0(in_double(r.q0.data(), m.nq)),
        v0(in_double(r.v_star.data(), m.nv)),
        shift(in_double(r.shift.data(), r.shift.size())),
        v1(in_double(r.v1.data(), m.nv)),
        c(in_double(multipliers.data(), m.nv)),
        anchors(in_double(r.anchors.data(), m.na)),
        by_next(in_double(g.anchors.data(), m.na)),
        h(real_part(r.h)),
        anchored(r.anchored.data()) {}
  ParamState state() const {
    return {h,         q0.data(), v0.data(),      shift.empty() ? nullptr : shift.data(),
            v1.data(), u.data(),  anchors.data(), anchored};
  }
  std::vector<double> params, u, q0, v0, shift, v1, c;
  std::vector<V3<double>> anchors, by_next;
  double h;
  const std::uint8_t* anchored;
};
template <class T>
struct ReadingInDouble {
  ReadingInDouble(const Model& m, const T* numbers, const StateView<T>& s, const T* by_reading)
      : params(in_double(numbers, m.param_names.size())),
        q(in_double(s.q, m.nq)),
        v(in_double(s.v, m.nv)),
        by(in_double(by_reading, static_cast<std::size_t>(m.markers) * 3)),
        anchors(in_double(s.anchors, m.na)),
        anchored(s.anchored) {}
  ParamState state(const Model& m) const {
    return {m.step, q.data(), v.data(), nullptr, nullptr, nullptr, anchors.data(), anchored};
  }
  std::vector<double> params, q, v, by;
  std::vector<V3<double>> anchors;
  const std::uint8_t* anchored;
};

template <class T>
void Batch<T>::transpose_one(int env, const Rollout<T>& r, const RolloutGradient<T>& g, StepMemory<T>& memory) {
  const Model& m = *model;
  const std::size_t nu = m.actuators.size(), na = m.na, N = n, e = env;
  const T* params = params_of(env);
  StateGradient<T> gradient(m);
  std::copy_n(reinterpret_cast<const V3<T>*>(g.anchors_end) + e * na, na, gradient.anchors.begin());
  std::copy_n(g.history_end + e * m.nh, m.nh, gradient.history.data());
  std::vector<Record<T>> records;
  int read = r.reads - 1;
  for (int t = r.steps; t >= 0; --t) {
    const std::size_t row = t * N + e;
    const StateView<T> now{r.q + row * m.nq, r.v + row * m.nv, reinterpret_cast<V3<T>*>(r.anchors) + row * na,
                           r.anchored + row * na, r.history + row * m.nh};
    gradient.q += to_tangent<T>(m, now.q, g.q + row * m.nq);
    gradient.v += Eigen::Map<const VX<T>>(g.v + row * m.nv, m.nv);
    for (; read >= 0 && r.read_after[read] == t; --read) {
      const T* by_reading = g.tactile + (read * N + e) * m.markers * 3;
      tactile_transposed<T>(m, params, now, by_reading, gradient, memory.work);
      if (g.params) {
        const ReadingInDouble<T> exact(m, params, now, by_reading);
        add_reading_param_gradient(m, exact.params.data(), exact.state(m), exact.by.data(),
                                   g.params + e * m.param_names.size());
      }
    }
    if (t == 0) break;
    // The step is taken again from where it started, so that each substep's start and anchors are at hand.
    const std::size_t before = (t - 1) * N + e;
    const StateView<T> old{r.q + before * m.nq, r.v + before * m.nv, reinterpret_cast<V3<T>*>(r.anchors) + before * na,
                           r.anchored + before * na, r.history + before * m.nh};
    const T* u = r.u + before * nu;
    records.clear();
    if (r.halvings[before] == 0) {
      const StepStart<T> from = start_of<T>(m, T(m.step), true, old, u, memory);
      records.emplace_back(m, from, Eigen::Map<const VX<T>>(now.v, m.nv), true);
    } else {
      StateCopy<T> scratch(m, old);
      gelflow::step<T>(m, params, u, m.polish, scratch.view(), memory, false,
                       [&](const StepStart<T>& from, const StepMemory<T>& taken) {
                         records.emplace_back(m, from, taken.v_new, false);
                       });
    }
    for (auto it = records.rbegin(); it != records.rend(); ++it) {
      substep_transposed<T>(m, params, u, *it, gradient, g.u + before * nu, memory, [&](const VX<T>& c) {
        if (!g.params) return;
        const StepInDouble<T> exact(m, params, u, *it, c, gradient);
        add_step_param_gradient(m, exact.params.data(), exact.state(), exact.c.data(), exact.by_next.data(),
                                g.params + e * m.param_names.size());
      });
    }
  }
  add_from_tangent<T>(m, r.q + e * m.nq, gradient.q, g.q0 + e * m.nq);
  std::copy_n(gradient.v.data(), m.nv, g.v0 + e * m.nv);
  std::copy_n(gradient.anchors.data(), na, reinterpret_cast<V3<T>*>(g.anchors0) + e * na);
  std::copy_n(gradient.history.data(), m.nh, g.history0 + e * m.nh);
}

template <class T>
void Batch<T>::rollout_transposed(const Rollout<T>& r, const RolloutGradient<T>& g) {
  const std::size_t N = n;
  std::fill_n(g.u, static_cast<std::size_t>(r.steps) * N * model->actuators.size(), T(0));
  std::fill_n(g.q0, N * model->nq, T(0));
  std::fill_n(g.v0, N * model->nv, T(0));
  std::fill_n(g.anchors0, N * model->na * 3, T(0));
  std::fill_n(g.history0, N * model->nh, T(0));
  if (g.params) std::fill_n(g.params, N * model->param_names.size(), 0.0);
  pool_.run(n, [&](int e, int thread) {
    if (r.status[e] == 0) transpose_one(e, r, g, memory_[thread]);  // a failed environment has gradient zero
  });
}

}  // namespace gelflow
