// N copies of a scene, each with its own state and parameters, stepped together on a persistent thread pool.
// Environments are independent, and each is computed by the same code in the same order whatever the number of threads
// or of environments: results are bit-identical.
#pragma once

#include <functional>
#include <memory>

#include "batch/rollout_readings.hpp"
#include "batch/rollout_vjp.hpp"
#include "batch/thread_pool.hpp"
#include "batch/trajectory.hpp"

namespace gelflow {

// Actuator controls: of each environment (N, nu), or shared by all (nu).
template <class T>
struct Controls {
  const T* u;
  bool shared;
};

// An interruption ends a call between two steps: the states of all environments are valid, results are incomplete.
// Functions with an `active` mask, (N) flags or null for all, leave the other environments and their results untouched.
template <class T>
class Batch {
 public:
  Batch(std::shared_ptr<const Model> model, int environments, int threads);

  const std::shared_ptr<const Model> model;
  const int n;
  std::vector<T> q, v, params;  // (N, nq), (N, nv), (N, params)
  std::vector<V3<T>> anchors;   // (N, na)
  std::vector<std::uint8_t> anchored;
  std::vector<T> history;            // (N, nh)
  std::vector<T> readings;           // (N, markers, 3) after the first update_readings(), which alone writes them
  std::vector<std::int32_t> status;  // (N)
  std::vector<std::int64_t> iterations, halved;  // (N): Newton iterations and halved steps since the reset

  int threads() const { return pool_.size(); }
  bool checks_params = true;                               // refuses wrong parameters (parameter_checks.hpp)
  std::atomic<int> calling_thread{0};                      // identifier of the thread inside a call; 0: none
  Interruption& interruption() { return *interruption_; }  // of the present call
  void reset(const std::uint8_t* which);                   // (N) flags, or null for all; parameters stay
  void step(const Controls<T>& u, int steps, const std::uint8_t* active);  // the controls are held for all steps
  // Difference between one step and two half steps under u, per dof (N, nv). A step that is halved is compared with
  // substeps half as long as its shortest. status (N) as in `status`. Changes nothing.
  void error_estimate(const Controls<T>& u, T* out, std::int32_t* status);
  void tactile(T* out, const std::uint8_t* active);  // (N, markers, 3)
  void update_readings(const std::uint8_t* active);  // the same into `readings`
  void reduced_tactile(const TactileReduction& reduction, T* out, const std::uint8_t* active);  // (N, rows)
  void wrenches(T* out);                                                                        // (N, contacts, 6)
  void contact_forces(T* out);                                     // (N, nv): joint forces of all contacts
  void poses(T* out);                                              // (N, bodies, 7): position, quaternion
  void mass_matrix(T* out);                                        // (N, nv, nv)
  void bias(T* out);                                               // (N, nv): Coriolis and gravity forces
  void rollout(const Trajectory<T>& r, const TouchStop* stop);     // `stop` may be null
  void contact_modes(const Trajectory<T>& r, std::uint64_t* out);  // (steps, N): signatures, see contact_modes.hpp
  // The gradient of environments that failed is zero.
  void rollout_vjp(const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent, const TrajectoryGradient<T>& out);

 private:
  friend class Batch<float>;  // which computes gradients in double precision
  StateView<T> state(int env);
  const T* params_of(int env) const {
    return params.data() + static_cast<std::size_t>(env) * model->param_names.size();
  }
  const T* controls_of(const Controls<T>& u, int env) const {
    return u.u + (u.shared ? 0 : static_cast<std::size_t>(env) * model->actuators.size());
  }
  void kinematics(int env, Workspace<T>& w);
  // Calls work(environment, thread) for all environments, or for the active ones.
  void for_all(const std::function<void(int, int)>& work) { pool_.run(n, work, *interruption_); }
  void for_active(const std::uint8_t* active, const std::function<void(int, int)>& work);
  void read(T* out, NonzeroMarkers* nonzero, const std::uint8_t* active);
  void read_one(int env, int thread, T* out, NonzeroMarkers* nonzero);
  void rollout_one(const Trajectory<T>& r, const TouchStop* stop, int env, int thread);
  void add_readings_vjp(const Trajectory<T>& r, const TrajectoryCotangent<T>& cotangent, double* grad_q,
                        double* grad_v);
  void check_state(const T* positions, const T* velocities, const std::uint8_t* active) const;  // (N, nq), (N, nv)
  void check_history(const T* histories, const std::uint8_t* active) const;                     // (N, nh)
  void check_anchors(const V3<T>* values, const std::uint8_t* is_set, const std::uint8_t* active) const;  // (N, na)
  void check_params(const std::uint8_t* active);
  void check_all(const std::uint8_t* active);  // state, history and parameters of the batch
  void check_controls(const T* u, int rows, const std::uint8_t* active) const;
  std::vector<StepMemory<T>> memory_;             // one per thread
  std::vector<ReadingMemory<T>> reading_memory_;  // one per thread
  std::vector<int> active_;                       // active environments of the present call
  std::vector<T> checked_params_;                 // (N, params): the last ones that were found valid
  std::vector<T> q_rounding_;                     // (N, nq) in single precision: rounding residual of q (StateView)
  std::unique_ptr<Batch<double>> double_batch_;   // in single precision: computes the gradients
  std::vector<NonzeroMarkers> nonzero_;           // per environment, of `readings`
  std::shared_ptr<Interruption> interruption_ = std::make_shared<Interruption>();
  ThreadPool pool_;
};

extern template class Batch<double>;
extern template class Batch<float>;

}  // namespace gelflow
