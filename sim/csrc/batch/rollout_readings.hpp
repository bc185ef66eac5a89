// Marker readings during a rollout: those that the trajectory records, per marker or reduced, and those of the touch
// stop.
#pragma once

#include <cmath>

#include "batch/trajectory.hpp"
#include "contact/tactile.hpp"

namespace gelflow {

// Memory of one thread for readings that are not written to the caller's array directly.
template <class T>
struct ReadingMemory {
  std::vector<T> forces;   // (markers, 3)
  NonzeroMarkers nonzero;  // of `forces`
  std::vector<double> sums;
  std::vector<double> reference_shear;  // per pad, see TouchStop
};

// Stops an environment after a step where the mean change of the shear along x, against the reading after the reference
// step, exceeds the threshold at a pad.
struct TouchStop {
  int reference_step, after_step;  // evaluated after this step and all later ones
  const double* threshold;         // (N) [N]; infinite: never
};

// The readings of one environment during a rollout.
template <class T>
class RolloutReadings {
 public:
  RolloutReadings(const Model& m, const T* params, const Trajectory<T>& r, const TouchStop* stop, std::size_t e,
                  StepMemory<T>& steps, ReadingMemory<T>& memory)
      : m_(m),
        params_(params),
        r_(r),
        stop_(stop != nullptr && stop->threshold[e] < std::numeric_limits<double>::infinity() ? stop : nullptr),
        e_(e),
        work_(steps.work),
        memory_(memory) {
    if (stop_ == nullptr && r.reduction == nullptr) return;
    memory_.forces.resize(static_cast<std::size_t>(m.num_markers) * 3);
    memory_.reference_shear.resize(m.pads.size());
  }

  // Reads what is due at the state after `step` steps. `moving`: the environment has neither stopped nor failed. Returns
  // whether the touch stop applies.
  bool read(int step, const StateView<T>& now, bool moving) {
    const bool record = next_ < r_.reads && r_.read_after[next_] == step;
    const bool check = moving && stop_ != nullptr && (step == stop_->reference_step || step >= stop_->after_step);
    if (!record && !check) return false;
    T* const recorded = record ? r_.tactile + r_.reading(m_, next_++, e_) : nullptr;
    if (stop_ == nullptr && r_.reduction == nullptr) {
      read_state(now, recorded, nullptr);
      return false;
    }
    if (!stopped_) read_state(now, memory_.forces.data(), &memory_.nonzero);
    if (record && r_.reduction != nullptr) r_.reduction->apply(memory_.forces.data(), memory_.sums, recorded);
    if (record && r_.reduction == nullptr) std::copy(memory_.forces.begin(), memory_.forces.end(), recorded);
    stopped_ = stopped_ || (check && exceeds(step));
    return stopped_;
  }

 private:
  void read_state(const StateView<T>& now, T* out, NonzeroMarkers* nonzero) {
    forward_state<false, T>(m_, params_, now.q, now.q_rounding, now.v, work_);
    read_markers<T>(m_, params_, now.anchors, now.anchored, work_, out, nonzero);
  }
  bool exceeds(int step) {
    double largest = 0;
    for (std::size_t p = 0; p < m_.pads.size(); ++p) {
      const int markers = m_.pads[p].cloud.size();
      const T* const first = memory_.forces.data() + 3 * static_cast<std::ptrdiff_t>(m_.pads[p].first_marker);
      double shear = 0;
      for (int i = 0; i < markers; ++i) shear += static_cast<double>(first[3 * i]);
      if (step == stop_->reference_step) memory_.reference_shear[p] = shear;
      largest = std::max(largest, std::abs(shear - memory_.reference_shear[p]) / markers);
    }
    return step >= stop_->after_step && largest > stop_->threshold[e_];
  }

  const Model& m_;
  const T* const params_;
  const Trajectory<T>& r_;
  const TouchStop* const stop_;  // null where the environment has none
  const std::size_t e_;
  Workspace<T>& work_;
  ReadingMemory<T>& memory_;
  int next_ = 0;          // reading of the trajectory
  bool stopped_ = false;  // `memory_.forces` is the reading at the stop
};

}  // namespace gelflow
