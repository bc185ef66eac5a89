// Layout of the physical parameters. Each environment has one flat parameter array, because randomization, calibration
// and gradients treat all parameters alike. The model's elements know the offset of their block in it (ParamBlock) and
// read it through a struct with named fields, at no cost.
#pragma once

#include <array>

#include "math/spatial.hpp"

namespace gelflow {

constexpr int world = -1;  // index of the fixed body

// The offset of one element's parameters; `in` views them in the flat array of an environment.
template <template <class> class Params>
struct ParamBlock {
  int offset = -1;

  template <class T>
  const Params<T>& in(const T* params) const {
    static_assert(sizeof(Params<T>) == Params<T>::names.size() * sizeof(T));
    return *reinterpret_cast<const Params<T>*>(params + offset);
  }
};

template <class T>
struct BodyParams {
  static constexpr std::array names{"mass",       "com.x",      "com.y",      "com.z",      "inertia.xx",
                                    "inertia.yy", "inertia.zz", "inertia.xy", "inertia.xz", "inertia.yz",
                                    "pos.x",      "pos.y",      "pos.z"};
  T mass;                          // [kg]
  V3<T> com;                       // centre of mass in the body frame [m]
  T ixx, iyy, izz, ixy, ixz, iyz;  // about the centre of mass, axes of the body frame [kg m²]
  V3<T> pos;                       // of the body frame in the parent's frame at q = 0 [m]

  M3<T> inertia() const {
    M3<T> m;
    m << ixx, ixy, ixz, ixy, iyy, iyz, ixz, iyz, izz;
    return m;
  }
};

// Gravity compensation of a body: the force −factor · mass · gravity at the point com + pos.
template <class T>
struct GravityCompensationParams {
  static constexpr std::array names{"gravcomp", "gravcomp.x", "gravcomp.y", "gravcomp.z"};
  T factor;
  V3<T> pos;  // from the centre of mass, in the body frame [m]
};

template <class T>
struct JointParams {
  static constexpr std::array names{"damping", "armature",        "stiffness",     "springref",   "lower",
                                    "upper",   "limit_stiffness", "limit_damping", "frictionloss"};
  T damping, armature, stiffness, springref;
  T lower, upper, limit_stiffness, limit_damping;
  T frictionloss;
};

// Position of a shape, a point set or a pad in its body frame, and a rotation vector that turns it from the orientation
// of the model.
template <class T>
struct PoseParams {
  static constexpr std::array names{"pos.x", "pos.y", "pos.z", "turn.x", "turn.y", "turn.z"};
  V3<T> pos, turn;
};

template <class T>
struct ScaleParams {
  static constexpr std::array names{"scale.x", "scale.y", "scale.z"};
  V3<T> scale;
};

// Half sizes or half axes; radius, then half length along z; the scale of a grid.
template <class T>
struct SizeParams {
  static constexpr std::array names{"size.x", "size.y", "size.z"};
  V3<T> size;
};

template <class T>
struct RoundingParams {
  static constexpr std::array names{"rounding"};
  T rounding;
};

// Penalty contact: normal stiffness, tangential (viscous) coefficient, friction coefficient, damping, tangential
// stiffness of the elastic law (contact_law.hpp).
template <class T>
struct ContactParams {
  static constexpr std::array names{"kn", "kt", "mu", "kd", "ks"};
  T kn, kt, mu, kd, ks;
};

template <class T>
struct ActuatorParams {
  static constexpr std::array names{"gear",       "kp",         "kd",   "force_lower", "force_upper",
                                    "ctrl_lower", "ctrl_upper", "gain", "bias"};
  T gear, kp, kd, force_lower, force_upper, ctrl_lower, ctrl_upper, gain, bias;
};

// A damped spring.
template <class T>
struct SpringParams {
  static constexpr std::array names{"stiffness", "damping"};
  T stiffness, damping;
};

// The damped springs of a loop closure, and the two points that it joins.
template <class T>
struct LoopClosureParams {
  static constexpr std::array names{"stiffness", "damping", "turn_stiffness", "turn_damping", "first.x",
                                    "first.y",   "first.z", "second.x",       "second.y",     "second.z"};
  T stiffness, damping;            // [N/m], [N s/m]
  T turn_stiffness, turn_damping;  // of a weld [N m/rad], [N m s/rad]
  V3<T> first, second;             // in the frames of the bodies [m]
};

template <class T>
struct GravityParams {
  static constexpr std::array names{"x", "y", "z"};
  V3<T> acceleration;  // [m/s²]
};

}  // namespace gelflow
