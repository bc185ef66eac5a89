// Values that a state cannot have. Each check throws std::invalid_argument at the first one. With `active`, only the
// environments whose entry is not 0 are checked.
#pragma once

#include <cstddef>
#include <cstdint>
#include <sstream>
#include <stdexcept>
#include <string>

#include "dynamics/kinematics.hpp"
#include "model/model.hpp"

namespace gelflow {

// Of the values (environments, width), called `name` in the message.
template <class T>
void check_finite(const T* values, const char* name, int environments, int width, const std::uint8_t* active) {
  const auto count = static_cast<std::size_t>(environments) * width;
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t environment = i / width;
    if (is_finite(values[i]) || (active != nullptr && active[environment] == 0)) continue;
    throw std::invalid_argument(std::string(name) + "[" + std::to_string(environment) + ", " +
                                std::to_string(i % width) + "] is not finite");
  }
}

// Of positions (environments, nq): a quaternion may have any length but 0, since the kinematics normalize it.
template <class T>
void check_quaternions(const Model& m, const T* positions, int environments, const std::uint8_t* active) {
  for (const Joint& joint : m.joints) {
    if (!joint.has_quaternion()) continue;
    const int first = joint.quaternion_q();
    for (int e = 0; e < environments; ++e) {
      const V4<T> quaternion = vec4(positions + static_cast<std::size_t>(e) * m.nq + first);
      constexpr double shortest = 1e-6;
      if (quaternion.squaredNorm() >= T(shortest * shortest) || (active != nullptr && active[e] == 0)) continue;
      std::ostringstream text;
      text << "environment " << e << ": the quaternion of joint '" << joint.name << "', q[" << first << ":" << first + 4
           << "], has length " << quaternion.stableNorm() << "; it must have length 1";
      throw std::invalid_argument(text.str());
    }
  }
}

}  // namespace gelflow
