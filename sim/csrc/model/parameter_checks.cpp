#include "model/parameter_checks.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>

#include "model/model.hpp"

namespace gelflow {

namespace {

constexpr std::string_view signed_names[] = {"mass",
                                             "inertia.xx",
                                             "inertia.yy",
                                             "inertia.zz",
                                             "damping",
                                             "armature",
                                             "stiffness",
                                             "frictionloss",
                                             "limit_stiffness",
                                             "limit_damping",
                                             "turn_stiffness",
                                             "turn_damping",
                                             "kn",
                                             "kt",
                                             "mu",
                                             "kd",
                                             "ks"};
constexpr std::string_view positive_names[] = {"mass",   "scale.x", "scale.y", "scale.z",
                                               "size.x", "size.y",  "size.z",  "rounding"};

template <std::size_t n>
bool contains(const std::string_view (&names)[n], std::string_view name) {
  return std::find(std::begin(names), std::end(names), name) != std::end(names);
}

// Whether an infinite value means that there is no limit.
bool is_limit(std::string_view name) { return name.ends_with("lower") || name.ends_with("upper"); }

constexpr double rounding = 1e-6;  // of parameters in single precision, relative to the largest element

// Whether a symmetric matrix has no negative eigenvalue: its principal minors are not negative, up to rounding errors.
bool is_positive(const M3<double>& m, double size) {
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3;
    if (m(i, i) < -rounding * size) return false;
    if (m(i, i) * m(j, j) - m(i, j) * m(i, j) < -rounding * size * size) return false;
  }
  return !(m.determinant() < -rounding * size * size * size);
}

// Why a symmetric matrix is no inertia of a rigid body; empty if it may be one. Of a body, each principal moment is at
// most the sum of the others: half the trace minus the inertia is the matrix of second moments of mass.
std::string wrong_inertia(const M3<double>& m) {
  const double size = m.cwiseAbs().maxCoeff();
  if (!is_positive(m, size)) return "have no negative principal moment";
  if (!is_positive(m.trace() / 2 * M3<double>::Identity() - m, size))
    return "have no principal moment above the sum of the others";
  return {};
}

template <class T>
std::string message(const std::string& name, const char* required, T got) {
  std::ostringstream text;
  text << "parameter '" << name << "' must " << required << ", got " << got;
  return text.str();
}

template <class T>
std::string wrong_actuator(const Model& model, const T* params) {
  for (const Actuator& actuator : model.actuators) {
    const auto p = actuator.params.in(params);
    if (p.force_lower > p.force_upper)
      return message(actuator.name + ".force_lower", "be at most the upper limit", p.force_lower);
    if (p.ctrl_lower > p.ctrl_upper)
      return message(actuator.name + ".ctrl_lower", "be at most the upper limit", p.ctrl_lower);
  }
  return {};
}

template <class T>
std::string wrong_rounding(const Model& model, const T* params) {
  for (const Shape& shape : model.shapes) {
    const bool box = shape.kind == ShapeKind::rounded_box;
    if (!box && shape.kind != ShapeKind::rounded_cylinder) continue;
    const T rounding = params[shape.size.offset + SizeParams<T>::names.size()];
    const T smallest = shape.size.in(params).size.head(box ? 3 : 2).minCoeff();
    if (rounding >= smallest) return message(shape.name + ".rounding", "be below the smallest half size", rounding);
  }
  return {};
}

// Of joints or tendons.
template <class Elements, class T>
std::string wrong_limits(const Elements& elements, const T* params) {
  for (const auto& element : elements) {
    const auto p = element.params.in(params);
    if (p.lower > p.upper) return message(element.name + ".lower", "be at most the upper limit", p.lower);
  }
  return {};
}

}  // namespace

ParamSign param_sign(std::string_view name, double value) {
  if (value > 0 && contains(positive_names, name)) return ParamSign::positive;
  return value >= 0 && contains(signed_names, name) ? ParamSign::not_negative : ParamSign::any;
}

template <class T>
std::string not_finite(const std::string& name, T value) {
  if (std::isnan(value)) return message(name, "be a number", value);
  if (std::isinf(value) && !is_limit(name)) return message(name, "be finite", value);
  return {};
}

template <class T>
std::string wrong_parameter(const Model& model, const T* params) {
  for (std::size_t i = 0; i < model.param_signs.size(); ++i) {
    const ParamSign sign = model.param_signs[i];
    if (!std::isfinite(params[i])) {
      const std::string wrong = not_finite(model.param_names[i], params[i]);
      if (!wrong.empty()) return wrong;
    }
    if (sign == ParamSign::positive && params[i] <= T(0))
      return message(model.param_names[i], "be positive", params[i]);
    if (sign == ParamSign::not_negative && params[i] < T(0)) {
      return message(model.param_names[i], "not be negative", params[i]);
    }
  }
  std::string wrong = wrong_limits(model.joints, params);
  if (wrong.empty()) wrong = wrong_limits(model.tendons, params);
  if (wrong.empty()) wrong = wrong_actuator(model, params);
  if (wrong.empty()) wrong = wrong_rounding(model, params);
  if (!wrong.empty()) return wrong;
  for (const Body& body : model.bodies) {
    const M3<double> before = body.params.in(model.param_defaults.data()).inertia();
    const M3<double> now = body.params.in(params).inertia().template cast<double>();
    wrong = wrong_inertia(now);
    if (!wrong.empty() && wrong_inertia(before).empty()) {
      std::ostringstream text;
      text << "the inertia of body '" << body.name << "' must " << wrong << ", got xx yy zz xy xz yz " << now(0, 0)
           << ' ' << now(1, 1) << ' ' << now(2, 2) << ' ' << now(0, 1) << ' ' << now(0, 2) << ' ' << now(1, 2);
      return text.str();
    }
  }
  return {};
}

template std::string not_finite<double>(const std::string&, double);
template std::string not_finite<float>(const std::string&, float);
template std::string wrong_parameter<double>(const Model&, const double*);
template std::string wrong_parameter<float>(const Model&, const float*);

}  // namespace gelflow
