// Checks of the definitions of a scene, and the enumerators of their names. All throw std::invalid_argument with the
// element's kind and name.
#pragma once

#include <array>
#include <cmath>
#include <stdexcept>

#include "model/definitions.hpp"
#include "model/model.hpp"

namespace gelflow {

[[noreturn]] inline void reject(const std::string& message) { throw std::invalid_argument(message); }

template <class Vector>
void check_finite(const std::string& owner, const char* what, const Vector& values) {
  for (Eigen::Index i = 0; i < values.size(); ++i) {
    if (!std::isfinite(values[i])) reject(owner + ": " + what + " has an entry that is not finite");
  }
}

void check_weights(const std::string& owner, const std::vector<double>& weights);
void check_contact_params(const std::string& owner, const ContactParams<double>& params, FrictionLaw law);
V4<double> unit_quaternion(const std::string& owner, const V4<double>& quat);
JointType joint_type(const std::string& owner, const std::string& name);
FrictionLaw friction_law(const std::string& owner, const std::string& name);
DampingLaw damping_law(const std::string& owner, const std::string& name);
ActuatorKind actuator_kind(const std::string& owner, const std::string& name);

// Checks size, rounding and grid too.
ShapeKind shape_kind(const std::string& owner, const ShapeDef& def);

}  // namespace gelflow
