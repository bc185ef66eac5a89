// Signed distance, gradient and Hessian at a point.
#pragma once

#include "math/vec3.hpp"

namespace gelflow {

// Form of the Hessian H: zero (flat faces); isotropic about the normal, κ (1 − n nᵀ) (spheres); general; general, of a
// smooth field whose gradient n has only nearly unit length (grids).
enum class HessianForm : std::uint8_t { zero, isotropic, general, field };

template <class P>
struct Distance {
  P d;
  Vec3<P> n;
  P curvature;       // κ, isotropic form only
  Mat3<P> hessian;   // general and field form only
  HessianForm form;  // the same for all points of a shape

  GELFLOW_INLINE Vec3<P> hessian_times(const Vec3<P>& a) const {
    return form == HessianForm::isotropic ? curvature * (a - dot(n, a) * n) : hessian * a;
  }
  GELFLOW_INLINE Mat3<P> hessian_matrix() const {
    return form == HessianForm::isotropic ? curvature * identity_minus_outer(n) : hessian;
  }
};

}  // namespace gelflow
