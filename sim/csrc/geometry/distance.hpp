// What a shape says of a point.
#pragma once

#include "math/simd_pack.hpp"

namespace gelflow {

// How the distance bends: not at all; as around a point; with a normal of unit length; as a smooth field whose gradient
// is only nearly so.
enum class HessianForm : std::uint8_t { zero, isotropic, general, field };

template <class P>
struct Distance {
  P d;
  Vec3<P> n;
  P curvature;       // round: H = bow (1 − n nᵀ)
  Mat3<P> hessian;   // only written where the distance bends and is not round
  HessianForm form;  // of the shape's kind, the same for all its points

  GELFLOW_INLINE Vec3<P> hessian_times(const Vec3<P>& a) const {
    return form == HessianForm::isotropic ? curvature * (a - dot(n, a) * n) : hessian * a;
  }
  GELFLOW_INLINE Mat3<P> hessian_matrix() const {
    return form == HessianForm::isotropic ? curvature * identity_minus_outer(n) : hessian;
  }
};

}  // namespace gelflow
