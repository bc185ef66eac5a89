// Values that physical parameters cannot have. Parameters of an environment may change at any time (parameters.hpp).
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

namespace gelflow {

struct Model;

enum class ParamSign : std::uint8_t { any, not_negative, positive };

// Of the parameter `name` of an element that is no actuator; `value`: its value in the model.
ParamSign param_sign(std::string_view name, double value);

// The error of a parameter whose value is not finite, such as "parameter 'box.mass' must be a number, got nan"; else
// empty. Limits may be infinite.
template <class T>
std::string not_finite(const std::string& name, T value);

// The first wrong parameter of an environment and what it must be, such as "parameter 'box.mass' must be positive, got
// -1"; else empty.
template <class T>
std::string wrong_parameter(const Model& model, const T* params);

}  // namespace gelflow
