// What a shape says of a point.
#pragma once

#include "lanes.hpp"

namespace gelflow {

// How the distance bends: not at all; with a normal of unit length; as a smooth field whose gradient is only nearly so.
enum class Bend : std::uint8_t { flat, curved, field };

template <class L>
struct Distance {
  L d;
  Vec3<L> n;
  Mat3<L> hessian;  // only written where the distance bends
  Bend bend;        // of the shape's kind, the same for all its points
};

}  // namespace gelflow
