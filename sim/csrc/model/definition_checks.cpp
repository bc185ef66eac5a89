#include "model/definition_checks.hpp"

#include <algorithm>

namespace gelflow {

void check_weights(const std::string& owner, const std::vector<double>& weights) {
  for (const double w : weights) {
    if (!(w >= 0) || !std::isfinite(w)) reject(owner + ": weights must be finite and not negative");
  }
}

void check_contact_params(const std::string& owner, const ContactParams<double>& params, FrictionLaw law) {
  const double values[] = {params.kn, params.kt, params.mu, params.kd, params.ks};
  for (std::size_t i = 0; i < std::size(values); ++i) {
    if (values[i] >= 0 && std::isfinite(values[i])) continue;
    reject(owner + ": " + ContactParams<double>::names[i] + " must be finite and not negative, got " +
           std::to_string(values[i]));
  }
  if (law == FrictionLaw::elastic && !(params.ks > 0)) reject(owner + ": the elastic friction law needs ks > 0");
}

V4<double> unit_quaternion(const std::string& owner, const V4<double>& quat) {
  if (!(std::abs(quat.norm() - 1) < 1e-6)) reject(owner + ": quat must have length 1");
  return quat.normalized();
}

JointType joint_type(const std::string& owner, const std::string& name) {
  if (name == "slide") return JointType::slide;
  if (name == "hinge") return JointType::hinge;
  if (name == "ball") return JointType::ball;
  if (name == "free") return JointType::free;
  reject(owner + ": type '" + name + "' is not one of slide, hinge, ball, free");
}

FrictionLaw friction_law(const std::string& owner, const std::string& name) {
  if (name == "viscous") return FrictionLaw::viscous;
  if (name == "elastic") return FrictionLaw::elastic;
  reject(owner + ": friction law '" + name + "' is not one of viscous, elastic");
}

DampingLaw damping_law(const std::string& owner, const std::string& name) {
  if (name == "hunt-crossley") return DampingLaw::hunt_crossley;
  if (name == "linear") return DampingLaw::linear;
  reject(owner + ": damping '" + name + "' is not one of hunt-crossley, linear");
}

ActuatorKind actuator_kind(const std::string& owner, const std::string& name) {
  if (name == "motor") return ActuatorKind::motor;
  if (name == "position") return ActuatorKind::position;
  if (name == "velocity") return ActuatorKind::velocity;
  if (name == "general") return ActuatorKind::general;
  reject(owner + ": kind '" + name + "' is not motor, position, velocity or general");
}

ShapeKind shape_kind(const std::string& owner, const ShapeDef& def) {
  struct Kind {
    const char* name;
    ShapeKind kind, rounded;
    int sizes;
  };
  constexpr ShapeKind none = ShapeKind::plane;  // can not be rounded
  constexpr Kind kinds[] = {{"plane", ShapeKind::plane, none, 0},
                            {"sphere", ShapeKind::sphere, none, 1},
                            {"box", ShapeKind::box, ShapeKind::rounded_box, 3},
                            {"cylinder", ShapeKind::cylinder, ShapeKind::rounded_cylinder, 2},
                            {"capsule", ShapeKind::capsule, none, 2},
                            {"ellipsoid", ShapeKind::ellipsoid, none, 3},
                            {"grid", ShapeKind::grid, none, 1}};
  const auto* kind =
      std::find_if(std::begin(kinds), std::end(kinds), [&](const Kind& k) { return def.kind == k.name; });
  if (kind == std::end(kinds)) {
    reject(owner + ": kind '" + def.kind + "' is not one of plane, sphere, box, cylinder, capsule, ellipsoid, grid");
  }
  for (int i = 0; i < kind->sizes; ++i) {
    if (!(def.size[i] > 0)) reject(owner + ": size must be positive");
  }
  if ((kind->kind == ShapeKind::grid) != (def.grid != nullptr)) reject(owner + ": a grid goes with the kind grid");
  if (!(def.rounding >= 0)) reject(owner + ": rounding must not be negative");
  if (def.rounding > 0 && kind->rounded == none) reject(owner + ": only a box or a cylinder can be rounded");
  if (def.rounding > 0 && !(def.rounding < def.size.head(kind->sizes).minCoeff())) {
    reject(owner + ": rounding must be below the smallest half size");
  }
  return def.rounding > 0 ? kind->rounded : kind->kind;
}

}  // namespace gelflow
