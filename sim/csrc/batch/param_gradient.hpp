// Partial derivatives with respect to the physical parameters; compiled once, in double precision. Derivatives through
// the state come from the reverse pass (adjoint.hpp).
#pragma once

#include "model/model.hpp"

namespace gelflow {

// A step from (q0, v0) to v1, see StepStart; or the state (q0, v0) of a reading, with null pointers for the rest.
struct ParamState {
  double beta_h;                             // β h
  const double *q0, *v0, *history, *v1, *u;  // v0 is v* of a step
  const V3<double>* anchors;
  const std::uint8_t* anchored;
};

// Adds −multipliersᵀ ∂residual/∂params + grad_nextᵀ ∂(anchors after the step)/∂params.
void add_step_param_gradient(const Model& m, const double* params, const ParamState& s, const double* multipliers,
                             const V3<double>* grad_next, double* grad_params);

// Adds grad_readingᵀ ∂readings/∂params.
void add_reading_param_gradient(const Model& m, const double* params, const ParamState& s, const double* grad_reading,
                                double* grad_params);

}  // namespace gelflow
