// Trajectories of many steps, and the reverse pass through them.
#pragma once

#include "batch/param_gradient.hpp"
#include "solver/adjoint.hpp"

namespace gelflow {

// Trajectories of a rollout: arrays of the caller, time first, then environment.
template <class T>
struct Rollout {
  int steps, reads;
  const T* u;              // (steps, N, nu)
  T *q, *v, *anchors;      // (steps + 1, N, ·); the first entry is the start
  T* history;              // (steps + 1, N, nh)
  std::uint8_t* anchored;  // (steps + 1, N, na)
  std::int8_t* halvings;   // (steps, N)
  std::int32_t* status;    // (N): 0, or why the environment stopped
  const int* read_after;   // (reads): markers are read after that many steps, increasing
  T* tactile;              // (reads, N, markers, 3)
};
template <class T>
struct RolloutGradient {
  const T *q, *v;             // in: of the trajectory, shaped as there
  const T* anchors_end;       // in: (N, na, 3), of the anchors at the end
  const T* history_end;       // in: (N, nh)
  const T* tactile;           // in: (reads, N, markers, 3)
  T *u, *q0, *v0, *anchors0;  // out
  T* history0;                // out, (N, nh)
  double* params;             // out, (N, params); null: not asked for
};

// The reverse pass of environment e of N. Parameters' gradients are double precision's, and so is T (`Batch<float>`).
template <class T>
void transpose_one(const Model& m, const T* params, std::size_t e, std::size_t N, const Rollout<T>& r,
                   const RolloutGradient<T>& g, StepMemory<T>& memory) {
  const std::size_t nu = m.actuators.size(), na = m.na;
  StateGradient<T> gradient(m);
  std::copy_n(reinterpret_cast<const V3<T>*>(g.anchors_end) + e * na, na, gradient.anchors.begin());
  std::copy_n(g.history_end + e * m.nh, m.nh, gradient.history.data());
  std::vector<SubstepRecord<T>> records;
  int read = r.reads - 1;
  for (int t = r.steps; t >= 0; --t) {
    const std::size_t row = t * N + e;
    const StateView<T> now{r.q + row * m.nq, r.v + row * m.nv, reinterpret_cast<V3<T>*>(r.anchors) + row * na,
                           r.anchored + row * na, r.history + row * m.nh};
    gradient.q += to_tangent<T>(m, now.q, g.q + row * m.nq);
    gradient.v += Eigen::Map<const VX<T>>(g.v + row * m.nv, m.nv);
    for (; read >= 0 && r.read_after[read] == t; --read) {
      const T* by_reading = g.tactile + (read * N + e) * m.markers * 3;
      tactile_vjp<T>(m, params, now, by_reading, gradient, memory.work);
      if (g.params) {
        const ParamState at{m.step, now.q, now.v, nullptr, nullptr, nullptr, now.anchors, now.anchored};
        add_reading_param_gradient(m, params, at, by_reading, g.params + e * m.param_names.size());
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
      const StepStart<T> from = step_start<T>(m, T(m.step), true, old, u, memory);
      records.emplace_back(m, from, Eigen::Map<const VX<T>>(now.v, m.nv), true);
    } else {
      StateCopy<T> scratch(m, old);
      gelflow::step<T>(m, params, u, m.polish, scratch.view(), memory, false,
                       [&](const StepStart<T>& from, const StepMemory<T>& taken) {
                         records.emplace_back(m, from, taken.v_new, false);
                       });
    }
    for (auto it = records.rbegin(); it != records.rend(); ++it) {
      substep_vjp<T>(m, params, u, *it, gradient, g.u + before * nu, memory, [&](const VX<T>& c) {
        if (!g.params) return;
        const ParamState at{
            it->h, it->q0.data(),      it->v_star.data(),  it->bdf2 ? it->history.data() : nullptr, it->v1.data(),
            u,     it->anchors.data(), it->anchored.data()};
        add_step_param_gradient(m, params, at, c.data(), gradient.anchors.data(), g.params + e * m.param_names.size());
      });
    }
  }
  add_from_tangent<T>(m, r.q + e * m.nq, gradient.q, g.q0 + e * m.nq);
  std::copy_n(gradient.v.data(), m.nv, g.v0 + e * m.nv);
  std::copy_n(gradient.anchors.data(), na, reinterpret_cast<V3<T>*>(g.anchors0) + e * na);
  std::copy_n(gradient.history.data(), m.nh, g.history0 + e * m.nh);
}

}  // namespace gelflow
