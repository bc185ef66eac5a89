// Newton's method for the velocity after a step: full steps first, then a search along the line, and where something
// saturates, by way of softer friction and servos.
#pragma once

#include <algorithm>

#include "math/linear_solver.hpp"
#include "solver/residual.hpp"

namespace gelflow {

enum class Status : std::int32_t { ok = 0, newton = 1, not_finite = 2 };

// Size of the residual relative to impulses.
template <class T>
double relative(const VX<T>& residual, const VX<T>& impulses, int n) {
  double total = 0;
  if constexpr (std::is_floating_point_v<T>) {
    using P = Pack<double>;
    const P least(1e-30);
    P squares(0.0);
    for (int k = 0; k < n; k += pack_width<double>) {  // behind the last stand zeros
      const P impulse = load<P>(&impulses[k]), value = load<P>(&residual[k]) / select(impulse > least, impulse, least);
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

// Whether the residual may be rounding errors alone: those of the impulses, of the momenta before the step (whose moments
// are taken about the world's origin), and of what one rounding unit of every position and velocity makes.
template <class T>
bool at_rounding_floor(const Model& m, const T* params, const StepStart<T>& from, const VX<T>& v,
                       const Workspace<T>& w) {
  const double unit = 20 * real_part(Eigen::NumTraits<T>::epsilon());
  double reach = 0, turn = 1, mass = 0, speed = 0, spin = 0;  // turn: of the largest angle, or of a quaternion
  for (const V3<PositionScalar<T>>& position : w.position) {
    for (int a = 0; a < 3; ++a) reach = std::max(reach, std::abs(real_part(position[a])));
  }
  for (const Joint& joint : m.joints) {
    if (joint.type == JointType::hinge) turn = std::max(turn, std::abs(real_part(from.q0[joint.q])));
  }
  for (const Body& body : m.bodies) mass += std::abs(real_part(params[body.mass]));
  for (int k = 0; k < m.nv; ++k) {
    double& fastest = m.angular[k] ? spin : speed;
    fastest = std::max(fastest, std::abs(real_part(from.v_star[k])));
  }
  const double momentum = mass * (speed + reach * spin) * (1 + real_part(from.h) * spin);
  for (int i = 0; i < m.nv; ++i) {
    double own = m.angular[i] ? reach * momentum : momentum, stiffness = 0;
    for (int j = 0; j < m.nv; ++j) {
      stiffness += std::abs(real_part(w.by_q(i, j))) * (m.angular[j] ? turn : reach);
      own += std::abs(real_part(w.by_v(i, j))) * (std::abs(real_part(v[j])) + std::abs(real_part(from.v_star[j])));
    }
    const double bound = unit * (stiffness + own + real_part(w.impulses[i]));
    if (!(std::abs(real_part(w.residual[i])) <= bound)) return false;
  }
  return true;
}

// Solves one substep; on success `v` is v_t, w.q and w.increment are those of it; where there are anchors, w holds the
// kinematics of (w.q, v) too.
// `polish` more Newton updates follow convergence (dual numbers need three for their derivative part).
//
// The first iterations take full steps whether the residual shrinks or not: contacts switch on and off, the residual is
// close to piecewise linear, and a full step into the right piece often makes the residual larger before the next one
// solves it, while a search along the line would stop at the first edge. Where that does not lead home, the search
// starts from the best point seen. Where the search gets stuck at an edge, the derivatives just past it say where to go.
//
// An update with derivatives of an earlier one shrinks the residual by some factor and not to its square, and so ends
// nearer to the tolerance: a margin makes up for it. In single precision there is no room for one. Who asks for the
// last digits gets them.
//
// Where the residual is within the tolerance, or a tenth of what such an update leaves would be, one more update follows
// whose residual is not measured, unless it has plenty of room already, or anchors move on from there: it costs little,
// and takes an error away that would else add up over many steps.
template <class T>
Status newton(const Model& m, const T* params, const StepStart<T>& from, int polish, VX<T>& v, int& iterations,
              Workspace<T>& w) {
  constexpr int full_steps = 6, patience = 6, most_old = 6;
  constexpr double quick = 0.15, enough = 0.1, exacting = 1e-9;
  constexpr double margin = std::is_same_v<T, PositionScalar<T>> ? 0.1 : 1.0, plenty = margin * margin;
  constexpr double least =
      std::is_same_v<T, PositionScalar<T>> ? 1000 : 100;  // rounding units; places are better than single
  const double own = std::max(m.tolerance, least * static_cast<double>(real_part(Eigen::NumTraits<T>::epsilon())));
  const double tolerance = from.continuation < 1 ? std::max(own, 1e-3) : own;
  const bool inexact = std::is_floating_point_v<T> && tolerance > exacting;
  bool fresh = false;  // w holds the derivatives at v
  const auto look = [&](bool derivatives, CacheState cache) {
    if (derivatives) {
      evaluate<true, T>(m, params, from, v.data(), cache, true, w);
    } else {
      evaluate<false, T>(m, params, from, v.data(), cache, true, w);
    }
    fresh = derivatives;
  };
  const auto measure = [&](bool derivatives) {
    look(derivatives, CacheState::current);
    return relative(w.residual, w.residual_scale, m.nv);
  };
  look(true, from.cache);
  w.residual_scale = w.impulses;  // what residuals are compared by
  double size = relative(w.residual, w.residual_scale, m.nv), best = size, before = size, mark = size;
  if (!std::isfinite(size)) return Status::not_finite;
  w.best = v;
  bool settled = false;  // no better residual can be had
  bool past = false;     // v lies just past an edge; the search goes on from w.start before it
  bool old = false;      // the last update was made with the derivatives of an earlier one
  for (int k = 0; k <= m.max_iterations; ++k) {
    // Where an update made the residual that much smaller, its derivatives do for one more, which costs a quarter.
    const bool again = inexact && !fresh && k <= most_old && size < quick * before;
    const bool unmeasured = inexact && m.na == 0 && polish <= 0 && (fresh || again);
    const double left = relative(w.residual, w.impulses, m.nv);
    const bool would_do = left <= (old ? margin : 1.0) * tolerance;
    const bool converged = settled || (unmeasured ? left <= plenty * tolerance : would_do);
    if (converged && polish-- <= 0) return Status::ok;
    if (k == m.max_iterations || iterations >= m.max_step_iterations) {
      return unmeasured && would_do ? Status::ok : Status::newton;
    }
    old = again && !converged;
    const bool last = unmeasured && (left <= tolerance || (old && size * (size / before) <= enough * tolerance));
    if (!fresh && !old) size = measure(true);
    if (!old) factorize<T>(w.tangent, m.nv, w.pivots);
    solve<T>(w.tangent, m.nv, w.pivots, w.residual.data(), w.direction);
    if (last && w.direction.allFinite()) {
      ++iterations;
      v -= w.direction;
      integrate_to_trial_state<T>(m, from, v.data(), w);
      return Status::ok;
    }
    if (last && would_do) return Status::ok;  // the matrix is singular
    if (past) {
      w.direction += w.start - v;
    } else {
      w.start = v;
      before = size;
    }
    ++iterations;
    const bool search = k >= full_steps && !converged;
    double fraction = 1;
    bool better = false;
    for (int tries = 0; tries < 13; ++tries, fraction *= 0.5) {
      v = w.start - w.direction * T(fraction);
      size = measure(false);
      better = size <= (1 - 1e-4 * fraction) * before;
      if (converged) break;
      settled = size > 0.5 * before && std::isfinite(size) && at_rounding_floor<T>(m, params, from, v, w);
      if (better || settled || (std::isfinite(size) && !search)) break;
    }
    if (size < best) {
      best = size;
      w.best = v;
    } else if (k + 1 == full_steps && !settled && !converged) {
      v = w.best;
      mark = best;
      size = measure(true);
    }
    if (!search || settled) continue;
    if (!better && (past || !std::isfinite(size))) break;
    past = !better;
    if ((k - full_steps) % patience == patience - 1) {
      if (best > 0.5 * mark) break;
      mark = best;
    }
  }
  return Status::newton;
}

// Where Newton did not converge. Mostly something saturates: points stick below a tiny speed and slip above it, a servo
// follows within a tiny error and pulls with its limit beyond. Full steps jump back and forth over that narrow range,
// and a search gets stuck beside it. So k_t, k_s and the gains start soft, which makes the range wide, and grow to what
// they are, each solution being the next one's start.
template <class T>
Status newton_by_continuation(const Model& m, const T* params, const StepStart<T>& from, int polish, VX<T>& v,
                              int& iterations, Workspace<T>& w) {
  constexpr double softest = 1e-8, least_growth = 1.3;
  StepStart<T> soft = from;
  VX<T> reached = v;
  double solved = 0, growth = 100;
  for (soft.continuation = softest;;) {
    v = reached;
    const Status status = newton<T>(m, params, soft, soft.continuation < 1 ? 0 : polish, v, iterations, w);
    if (status == Status::ok) {
      if (soft.continuation == 1) return status;
      reached = v;
      solved = soft.continuation;
    } else {
      growth = std::sqrt(growth);
      if (solved == 0 || growth < least_growth) return status;
    }
    soft.continuation = std::min(1.0, solved * growth);
  }
}

}  // namespace gelflow
