// What a shape says of a point.
#pragma once

#include "math/simd_pack.hpp"

namespace gelflow {

// How the distance bends: not at all; as around a point; with a normal of unit length; as a smooth field whose gradient
// is only nearly so.
enum class Bend : std::uint8_t { flat, round, curved, field };

template <class L>
struct Distance {
  L d;
  Vec3<L> n;
  L bow;            // round: H = bow (1 − n nᵀ)
  Mat3<L> hessian;  // only written where the distance bends and is not round
  Bend bend;        // of the shape's kind, the same for all its points

  GELFLOW_INLINE Vec3<L> curvature_times(const Vec3<L>& a) const {
    return bend == Bend::round ? bow * (a - dot(n, a) * n) : hessian * a;
  }
  GELFLOW_INLINE Mat3<L> curvature() const { return bend == Bend::round ? bow * identity_minus_outer(n) : hessian; }
};

}  // namespace gelflow
