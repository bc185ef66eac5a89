// Newton's method for the velocity after a step: full steps first, then a backtracking line search and, if both fail,
// continuation in the stiffness of friction and servos.
#pragma once

#include <algorithm>

#include "solver/couplings.hpp"
#include "solver/residual.hpp"

namespace gelflow {

enum class Status : std::int32_t { ok = 0, not_converged = 1, not_finite = 2 };

// √Σ (g_k / s_k)², the residual relative to impulses s; infinity if it is not finite.
template <class T>
double relative_norm(const VX<T>& residual, const VX<T>& impulses, int n) {
  double total = 0;
  if constexpr (std::is_floating_point_v<T>) {
    using P = Pack<double>;
    const P smallest(1e-30);
    P squares(0.0);
    for (int k = 0; k < n; k += pack_width<double>) {  // both vectors are padded with zeros
      const P impulse = load<P>(&impulses[k]);
      const P value = load<P>(&residual[k]) / select(impulse > smallest, impulse, smallest);
      squares += value * value;
    }
    total = sum(squares);
  } else {
    for (int k = 0; k < n; ++k) {
      const double value = real_part(residual[k]) / std::max<double>(real_part(impulses[k]), 1e-30);
      total += value * value;
    }
  }
  return std::isfinite(total) ? std::sqrt(total) : std::numeric_limits<double>::infinity();
}

// Whether the residual may consist of rounding errors alone. The bound per row is the sum of the rounding errors of the
// impulses, of the momenta before the step (with moments about the world's origin), and of the effect of one rounding
// unit of every position and velocity.
template <class T>
bool at_rounding_floor(const Model& m, const T* params, const StepStart<T>& start, const VX<T>& v,
                       const Workspace<T>& w) {
  const double unit = 20 * real_part(Eigen::NumTraits<T>::epsilon());
  double reach = 0, angle = 1, mass = 0, speed = 0, spin = 0;  // angle: the largest one, 1 for a quaternion
  for (const V3<PositionScalar<T>>& position : w.position) {
    for (int a = 0; a < 3; ++a) reach = std::max(reach, std::abs(real_part(position[a])));
  }
  for (const Joint& joint : m.joints) {
    if (joint.type == JointType::hinge) angle = std::max(angle, std::abs(real_part(start.q0[joint.q])));
  }
  for (const Body& body : m.bodies) mass += std::abs(real_part(body.params.in(params).mass));
  for (int k = 0; k < m.nv; ++k) {
    double& fastest = m.angular[k] ? spin : speed;
    fastest = std::max(fastest, std::abs(real_part(start.v_star[k])));
  }
  const double momentum = mass * (speed + reach * spin) * (1 + real_part(start.beta_h) * spin);
  const auto bound_of_row = [&](int i) {
    double velocity_terms = m.angular[i] ? reach * momentum : momentum, position_terms = 0;
    w.layout.for_dofs(w.layout.island_of(i), [&](int j) {
      position_terms += std::abs(real_part(w.dg_dq(i, j))) * (m.angular[j] ? angle : reach);
      velocity_terms +=
          std::abs(real_part(w.dg_dv(i, j))) * (std::abs(real_part(v[j])) + std::abs(real_part(start.v_star[j])));
    });
    return unit * (position_terms + velocity_terms + real_part(w.impulses[i]));
  };
  for (int i = 0; i < m.nv; ++i) {
    double bound = bound_of_row(i);
    for (const Coupling& c : m.couplings) {
      if (c.leader_dof == i) bound += std::abs(c.ratio) * bound_of_row(c.dof);
    }
    if (!(std::abs(real_part(w.residual[i])) <= bound)) return false;
  }
  return true;
}

// Solves g(v_t) = 0 for one substep. On success `v` is v_t, w.q and w.increment belong to it; where there are anchors, w
// also holds the kinematics of (w.q, v). `polish` further Newton updates follow convergence (dual numbers need three for
// their derivative part).
//
// Globalization. The first iterations take full steps even where the residual grows: contacts switch on and off, so the
// residual is close to piecewise linear; a full step into the right piece often increases the residual before the next
// one solves it, while a line search would stop at the first kink. If full steps do not converge, a line search starts
// from the best iterate. If the line search gets stuck at a kink, the next direction uses the Jacobian just past it.
//
// Jacobian reuse. After an update that decreased the residual strongly, the factorized Jacobian serves one more update,
// which costs a quarter of an update that evaluates and factorizes the Jacobian. Such an update converges linearly and
// ends nearer to the tolerance, so double precision tightens the tolerance by a safety factor; single precision has no
// room for one. Tight tolerances disable Jacobian reuse.
//
// Unverified last iteration. One more update is applied without evaluating its residual if the residual is within the
// tolerance, or is expected to be within a tenth of it after an update with the reused Jacobian. It is not applied if
// the residual is far below the tolerance already, or if anchors depend on the result. The update is cheap and removes
// an error that would otherwise accumulate over many steps.
template <class T>
class NewtonSolver {
 public:
  NewtonSolver(const Model& m, const T* params, const StepStart<T>& start, int polish, VX<T>& v, int& iterations,
               Workspace<T>& w)
      : m_(m),
        params_(params),
        start_(start),
        v_(v),
        iterations_(iterations),
        w_(w),
        tolerance_(tolerance_of(m, start)),
        allows_shortcuts_(std::is_floating_point_v<T> && tolerance_ > no_shortcuts_below),
        polish_(polish) {}

  GELFLOW_INLINE Status solve() {
    if (!evaluate_start()) return Status::not_finite;
    for (int k = 0; k <= m_.max_iterations; ++k) {
      const Convergence test = test_convergence(k);
      if (test.converged && polish_-- <= 0) return Status::ok;
      if (k == m_.max_iterations || iterations_ >= m_.max_step_iterations) {
        return test.skips_check && test.within_tolerance ? Status::ok : Status::not_converged;
      }
      compute_direction(test.reuses_jacobian && !test.converged);
      if (is_final(test)) {
        if (w_.direction.allFinite()) return apply_final_update();
        if (test.within_tolerance) return Status::ok;  // the Jacobian is singular
      }
      const bool search = k >= full_steps && !test.converged;
      const bool decreased = take_step(search, test.converged);
      keep_best(k + 1 == full_steps && !test.converged);
      if (search && !at_floor_ && is_stalled(k, decreased)) break;
    }
    return Status::not_converged;
  }

 private:
  static constexpr int full_steps = 6, stall_window = 6, max_reuse_iteration = 6, max_backtracks = 12;
  static constexpr double reuse_decrease = 0.15, final_fraction = 0.1, no_shortcuts_below = 1e-9, armijo = 1e-4;
  static constexpr bool single_precision = !std::is_same_v<T, PositionScalar<T>>;
  static constexpr double safety = single_precision ? 1.0 : 0.1, far_below = safety * safety;

  struct Convergence {
    bool reuses_jacobian;  // the factorized Jacobian is good enough for one more update
    bool skips_check;      // the residual of the next update need not be evaluated
    bool within_tolerance;
    bool converged;
    double residual;  // relative to the impulses at this iterate
  };

  // The tolerance is at least 1000 (double) or 100 (single precision) rounding units, and loose while the
  // continuation factor is below 1.
  static double tolerance_of(const Model& m, const StepStart<T>& start) {
    constexpr double units = single_precision ? 100 : 1000;
    const double tolerance =
        std::max(m.tolerance, units * static_cast<double>(real_part(Eigen::NumTraits<T>::epsilon())));
    return start.continuation < 1 ? std::max(tolerance, 1e-3) : tolerance;
  }

  GELFLOW_INLINE void evaluate_at_v(bool jacobian, CacheState cache) {
    if (jacobian) {
      evaluate<true, T>(m_, params_, start_, v_.data(), cache, true, w_);
    } else {
      evaluate<false, T>(m_, params_, start_, v_.data(), cache, true, w_);
    }
    jacobian_current_ = jacobian;
    if (m_.couplings.empty() && m_.prescribed_dofs.empty()) return;
    reduce_couplings<T>(m_, w_.residual);
    remove_prescribed<T>(m_, w_.residual);
    reduce_absolute_couplings<T>(m_, w_.impulses);
    if (!jacobian) return;
    reduce_couplings<T>(m_, w_.layout, w_.tangent);
    remove_prescribed<T>(m_, w_.layout, w_.tangent);
  }
  GELFLOW_INLINE void measure(bool jacobian) {
    evaluate_at_v(jacobian, CacheState::current);
    norm_ = relative_norm(w_.residual, w_.residual_scale, m_.nv);
  }

  // Residual and Jacobian at the initial guess, whose impulses scale all residuals. False where not finite.
  GELFLOW_INLINE bool evaluate_start() {
    evaluate_at_v(true, start_.cache);
    w_.residual_scale = w_.impulses;
    norm_ = relative_norm(w_.residual, w_.residual_scale, m_.nv);
    best_norm_ = previous_norm_ = stall_norm_ = norm_;
    if (!std::isfinite(norm_)) return false;
    w_.best_velocity = v_;
    return true;
  }

  GELFLOW_INLINE Convergence test_convergence(int k) const {
    Convergence test;
    test.reuses_jacobian =
        allows_shortcuts_ && !jacobian_current_ && k <= max_reuse_iteration && norm_ < reuse_decrease * previous_norm_;
    test.skips_check = allows_shortcuts_ && m_.na == 0 && polish_ <= 0 && (jacobian_current_ || test.reuses_jacobian);
    // At the initial guess both scales are the same.
    test.residual = k == 0 ? norm_ : relative_norm(w_.residual, w_.impulses, m_.nv);
    test.within_tolerance = test.residual <= (jacobian_reused_ ? safety : 1.0) * tolerance_;
    test.converged = at_floor_ || (test.skips_check ? test.residual <= far_below * tolerance_ : test.within_tolerance);
    return test;
  }

  // direction = J⁻¹ g, with the Jacobian at v or, where `reuse`, the factorized one of the previous update.
  GELFLOW_INLINE void compute_direction(bool reuse) {
    jacobian_reused_ = reuse;
    if (!reuse) {
      if (!jacobian_current_) measure(true);
      factorize_tangent<T>(w_);
    }
    solve_tangent<T>(w_, w_.residual, w_.direction);
    expand_couplings<T>(m_, w_.direction);
  }

  // Whether the next update is the last one, by the residual that it is expected to leave.
  GELFLOW_INLINE bool is_final(const Convergence& test) const {
    return test.skips_check && (test.residual <= tolerance_ ||
                                (jacobian_reused_ && norm_ * (norm_ / previous_norm_) <= final_fraction * tolerance_));
  }
  GELFLOW_INLINE Status apply_final_update() {
    ++iterations_;
    v_ -= w_.direction;
    integrate_to_trial_state<T>(m_, start_, v_.data(), w_);
    return Status::ok;
  }

  // Takes the full step, or with `search` the first halved one with sufficient decrease. Returns whether the residual
  // decreased sufficiently. Past a kink, steps start from the iterate before it.
  GELFLOW_INLINE bool take_step(bool search, bool converged) {
    if (past_kink_) {
      w_.direction += w_.search_start - v_;
    } else {
      w_.search_start = v_;
      previous_norm_ = norm_;
    }
    ++iterations_;
    double fraction = 1;
    for (int halvings = 0; halvings <= max_backtracks; ++halvings, fraction *= 0.5) {
      v_ = w_.search_start - w_.direction * T(fraction);
      measure(false);
      const bool decreased = norm_ <= (1 - armijo * fraction) * previous_norm_, finite = std::isfinite(norm_);
      if (converged) return decreased;
      at_floor_ = norm_ > 0.5 * previous_norm_ && finite && at_rounding_floor<T>(m_, params_, start_, v_, w_);
      if (decreased || at_floor_ || (finite && !search)) return decreased;
    }
    return false;
  }

  // Remembers the best iterate; the line search starts from it after the last full step.
  GELFLOW_INLINE void keep_best(bool full_steps_end) {
    if (norm_ < best_norm_) {
      best_norm_ = norm_;
      w_.best_velocity = v_;
    } else if (full_steps_end && !at_floor_) {
      v_ = w_.best_velocity;
      stall_norm_ = best_norm_;
      measure(true);
    }
  }

  // Whether the line search makes no progress: no decrease past a kink either, or less than half in `stall_window`
  // iterations.
  GELFLOW_INLINE bool is_stalled(int k, bool decreased) {
    if (!decreased && (past_kink_ || !std::isfinite(norm_))) return true;
    past_kink_ = !decreased;
    if ((k - full_steps) % stall_window != stall_window - 1) return false;
    if (best_norm_ > 0.5 * stall_norm_) return true;
    stall_norm_ = best_norm_;
    return false;
  }

  const Model& m_;
  const T* const params_;
  const StepStart<T>& start_;
  VX<T>& v_;
  int& iterations_;
  Workspace<T>& w_;
  const double tolerance_;
  const bool allows_shortcuts_;  // Jacobian reuse and the unverified last iteration are allowed
  int polish_;

  double norm_ = 0, previous_norm_ = 0;    // of the residual at v, and before the last step
  double best_norm_ = 0, stall_norm_ = 0;  // the smallest so far, now and when progress was last checked
  bool at_floor_ = false;                  // the residual is at the rounding floor
  bool past_kink_ = false;                 // v lies just past a kink; steps start from w.search_start before it
  bool jacobian_current_ = false;          // w holds the derivatives at v
  bool jacobian_reused_ = false;           // by the last update
};

template <class T>
Status newton(const Model& m, const T* params, const StepStart<T>& start, int polish, VX<T>& v, int& iterations,
              Workspace<T>& w) {
  return NewtonSolver<T>(m, params, start, polish, v, iterations, w).solve();
}

// Continuation (homotopy), where Newton's method did not converge. The usual cause is saturation: points stick below a
// tiny slip speed and slide above it; a servo saturates at its force limit beyond a tiny error. Full steps jump back and
// forth over that narrow range, and a line search gets stuck beside it. So k_t, k_s and the gains are scaled by a factor
// that starts small, which widens the range, and grows to 1; each solution is the next initial guess.
template <class T>
Status newton_by_continuation(const Model& m, const T* params, const StepStart<T>& start, int polish, VX<T>& v,
                              int& iterations, Workspace<T>& w) {
  constexpr double smallest = 1e-8, min_growth = 1.3;
  StepStart<T> scaled = start;
  VX<T> solution = v;
  double solved = 0, growth = 100;
  for (scaled.continuation = smallest;;) {
    v = solution;
    const Status status = newton<T>(m, params, scaled, scaled.continuation < 1 ? 0 : polish, v, iterations, w);
    if (status == Status::ok) {
      if (scaled.continuation == 1) return status;
      solution = v;
      solved = scaled.continuation;
    } else {
      growth = std::sqrt(growth);
      if (solved == 0 || growth < min_growth) return status;
    }
    scaled.continuation = std::min(1.0, solved * growth);
  }
}

}  // namespace gelflow
