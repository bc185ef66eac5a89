// Directional derivatives of a rollout by dual numbers through the whole core: the exact reference for the analytic
// derivatives, and the Jacobian of few inputs and many outputs. One environment, double precision.
#pragma once

#include "model/model.hpp"

namespace gelflow {

// Initial state, parameters and controls of a rollout, or a direction in their space: then q has nv entries, a tangent
// vector, and anchored is unused.
struct RolloutInput {
  const double *params, *q, *v, *anchors, *history, *u;  // u (steps, nu)
  const std::uint8_t* anchored;
};

// The state and the marker readings at the end, or their derivatives: then q is a tangent vector.
struct RolloutEnd {
  std::vector<double> q, v, anchors, tactile;
};

struct DirectionalRollout {
  RolloutEnd end;
  std::vector<RolloutEnd> derivatives;  // one of each direction
  std::vector<std::uint8_t> anchored;
  std::int32_t status = 0;
};

// Several directions together take less time than one after the other.
DirectionalRollout directional_rollout(const Model& m, int steps, const RolloutInput& start,
                                       const std::vector<RolloutInput>& directions);

}  // namespace gelflow
