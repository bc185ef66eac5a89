// Gradients by physical parameters; the implementation is compiled once, in double precision.
#pragma once

#include "model/model.hpp"

namespace gelflow {

// A step (StepStart of residual.hpp) to v1; or, for a reading, the state (q0, v0) alone.
struct ParamState {
  double h;
  const double *q0, *v0, *history, *v1, *u;  // v0 is the step's v*
  const V3<double>* anchors;
  const std::uint8_t* anchored;
};

// Adds −multipliersᵀ ∂residual/∂params + by_nextᵀ ∂(anchors after the step)/∂params.
void add_step_param_gradient(const Model& m, const double* params, const ParamState& s, const double* multipliers,
                             const V3<double>* by_next, double* by_params);

// Adds by_readingᵀ ∂readings/∂params.
void add_reading_param_gradient(const Model& m, const double* params, const ParamState& s, const double* by_reading,
                                double* by_params);

}  // namespace gelflow
