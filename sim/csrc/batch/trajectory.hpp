// Named views of the arrays of a rollout and of its reverse pass. The caller owns the memory. Arrays are C-contiguous,
// time first, then environment; N is the number of environments.
#pragma once

#include "contact/tactile_reduction.hpp"
#include "solver/step.hpp"

namespace gelflow {

template <class T>
struct Trajectory {
  int steps, reads, environments;
  bool end_only;                      // the states have one row: that of the last step taken so far
  const T* u;                         // (steps, N, nu)
  T *q, *v, *anchors;                 // (steps + 1, N, ·) or (1, N, ·); the first entry is the initial state
  T* history;                         // (steps + 1 or 1, N, nh)
  std::uint8_t* anchored;             // (steps + 1 or 1, N, na)
  std::int8_t* halvings;              // (steps, N)
  std::int32_t* status;               // (N): a Status
  const std::uint8_t* active;         // (N): 0 where the environment rests: no step and no reading
  std::int32_t* stopped_at;           // (N): number of steps before the touch stop; −1 without a stop
  const int* read_after;              // (reads): numbers of steps after which the markers are read, increasing
  const TactileReduction* reduction;  // of the readings; null: none
  T* tactile;                         // (reads, N, markers, 3), or (reads, N, rows) with a reduction

  // Row of an environment after `step` steps, in arrays with one row per step and environment.
  std::size_t row(int step, std::size_t e) const { return static_cast<std::size_t>(step) * environments + e; }
  StateView<T> state(const Model& m, int step, std::size_t e, T* q_rounding = nullptr) const {
    const std::size_t i = row(end_only ? 0 : step, e);
    return {q + i * m.nq,        v + i * m.nv,       reinterpret_cast<V3<T>*>(anchors) + i * m.na,
            anchored + i * m.na, history + i * m.nh, q_rounding};
  }
  // Controls of the step that starts after `step` steps.
  const T* controls(const Model& m, int step, std::size_t e) const { return u + row(step, e) * m.actuators.size(); }
  std::size_t reading_size(const Model& m) const {
    return static_cast<std::size_t>(reduction == nullptr ? m.num_markers * 3 : reduction->rows());
  }
  // Offset of an environment's reading in `tactile`.
  std::size_t reading(const Model& m, int read, std::size_t e) const { return row(read, e) * reading_size(m); }
  // Number of steps before an environment stopped; its state does not change in later ones.
  int steps_taken(std::size_t e) const { return active[e] == 0 ? 0 : stopped_at[e] < 0 ? steps : stopped_at[e]; }
};

// Gradient of a scalar by the results of a rollout: the input of the reverse pass.
template <class T>
struct TrajectoryCotangent {
  const T *q, *v;        // shaped as in the trajectory; q by the quaternion's four numbers
  const T* anchors_end;  // (N, na, 3)
  const T* history_end;  // (N, nh)
  const T* tactile;      // shaped as in the trajectory
};

// Gradient of the scalar by the inputs of a rollout: the output of the reverse pass.
template <class T>
struct TrajectoryGradient {
  T* u;            // (steps, N, nu)
  T *q, *v;        // of the initial state: (N, nq), (N, nv)
  T* anchors;      // (N, na, 3)
  T* history;      // (N, nh)
  double* params;  // (N, parameters); null: not computed
};

}  // namespace gelflow
