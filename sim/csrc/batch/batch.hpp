// The unit of work: N copies of a scene, each with its own state and parameters, stepped together on persistent
// threads. Environments are independent, and each is computed by the same code in the same order whatever the number
// of threads or of environments: results are the same bit for bit.
#pragma once

#include <atomic>
#include <condition_variable>
#include <functional>
#include <memory>
#include <mutex>
#include <thread>

#include "batch/rollout.hpp"

namespace gelflow {

// Threads that stay. Waking one up takes longer than some steps, so whoever waits looks out for a moment before going to
// sleep.
class ThreadPool {
 public:
  explicit ThreadPool(int threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;
  int size() const;
  // work(item, thread) for every item below `items`; returns when all are done.
  void run(int items, const std::function<void(int, int)>& work);

 private:
  struct Helper;
  void loop(Helper& helper, int thread);
  void take(int thread);
  std::vector<std::unique_ptr<Helper>> helpers_;
  std::mutex mutex_;
  std::condition_variable start_, done_;
  const std::function<void(int, int)>* work_ = nullptr;
  std::atomic<int> next_{0};
  int items_ = 0;
  std::atomic<int> busy_{0};  // threads at work
  std::atomic<std::uint64_t> round_{0};
  std::atomic<bool> stop_{false};
  int asleep_ = 0;  // threads that wait for `start_`
};

// What the actuators are told: numbers of every environment (N, nu), or of all alike (nu).
template <class T>
struct Controls {
  const T* numbers;
  bool alike;
};

template <class T>
class Batch {
 public:
  Batch(std::shared_ptr<const Model> model, int environments, int threads);

  const std::shared_ptr<const Model> model;
  const int n;
  std::vector<T> q, v, params;  // (N, nq), (N, nv), (N, params)
  std::vector<V3<T>> anchors;   // (N, na)
  std::vector<std::uint8_t> anchored;
  std::vector<T> history;                        // (N, nh)
  std::vector<T> readings;                       // (N, markers, 3) once they were asked for; for nobody else to write
  std::vector<std::int32_t> status;              // (N)
  std::vector<std::int64_t> iterations, halved;  // (N): Newton iterations and halved steps since the reset

  int threads() const { return pool_.size(); }
  void reset(const std::uint8_t* which);       // null: all; parameters stay
  void step(const Controls<T>& u, int steps);  // held for all steps
  // What one step under u differs by from two half steps, per dof (N, nv); where it has to be halved, from parts half as
  // long as its shortest. status (N) as in `status`. Changes nothing.
  void error_estimate(const Controls<T>& u, T* out, std::int32_t* status);
  void tactile(T* out);         // (N, markers, 3)
  void tactile();               // the same into `readings`
  void wrenches(T* out);        // (N, contacts, 6)
  void contact_forces(T* out);  // (N, nv): what all contacts do to the joints
  void poses(T* out);           // (N, bodies, 7): position, quaternion
  void mass_matrix(T* out);     // (N, nv, nv)
  void bias(T* out);            // (N, nv): Coriolis and gravity forces
  void rollout(const Rollout<T>& r);
  // Signature of the branches that each step took, (steps, N).
  void branches(const Rollout<T>& r, std::uint64_t* out);
  void rollout_transposed(const Rollout<T>& r, const RolloutGradient<T>& g);

 private:
  StateView<T> state(int env);
  const T* params_of(int env) const {
    return params.data() + static_cast<std::size_t>(env) * model->param_names.size();
  }
  void kinematics(int env, Workspace<T>& w);
  void read(T* out, DirtyMarkers* dirty);
  void check_state() const;
  void check_controls(const T* u, int rows) const;
  std::vector<StepMemory<T>> memory_;     // one per thread
  std::vector<T> q_rounding_;             // (N, nq) in single precision: what q lacks (StateView)
  std::unique_ptr<Batch<double>> exact_;  // in single precision: for gradients
  std::vector<DirtyMarkers> dirty_;       // per environment, of `readings`
  ThreadPool pool_;
};

extern template class Batch<double>;
extern template class Batch<float>;

// Derivative of a rollout along one direction, by dual numbers through the whole core: the exact reference that the
// analytic derivatives are checked against. One environment; tangents of q have nv entries.
struct DirectionalRollout {
  std::vector<double> q, v, anchors, tactile;      // at the end
  std::vector<double> dq, dv, danchors, dtactile;  // their derivatives; dq as a tangent
  std::vector<std::uint8_t> anchored;
  std::int32_t status = 0;
};
struct RolloutStart {
  const double *params, *q, *v, *anchors, *history, *u;  // u (steps, nu)
  const std::uint8_t* anchored;
  const double *dparams, *dq, *dv, *danchors, *dhistory, *du;  // the direction; dq as a tangent
  int steps;
};
DirectionalRollout directional_rollout(const Model& m, const RolloutStart& start);

}  // namespace gelflow
