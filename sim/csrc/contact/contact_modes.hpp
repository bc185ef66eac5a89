// Contact mode signature: which points are in contact, stick or slide, and which actuators are clipped. Two runs with
// equal signatures lie on the same smooth piece of the simulator's function; finite differences are meaningful only
// there.
#pragma once

#include "solver/step.hpp"

namespace gelflow {

class ModeHash {
 public:
  void add(std::uint64_t value) { hash_ = (hash_ ^ (value + 0x9e3779b97f4a7c15ULL)) * 0x100000001b3ULL; }
  std::uint64_t value() const { return hash_; }

 private:
  std::uint64_t hash_ = 0xcbf29ce484222325ULL;
};

// Code of the shape's face nearest to a point, by the normal: by its signs where faces are flat, by its zeros where they
// are curved (the ends and the side of a cylinder or capsule).
template <class T>
std::uint64_t face_code(const V3<T>& normal, bool curved) {
  std::uint64_t code = curved ? 1 : 0;
  for (int a = 0; a < 3; ++a) {
    const int sign = normal[a] > T(0) ? 1 : normal[a] < T(0) ? 2 : 0;
    code = code * 3 + (curved ? (sign == 0 ? 0 : 1) : sign);
  }
  return code;
}

// Adds the modes of the active points of a pair. Needs the kinematics of the state in w.
template <class T>
void add_contact_modes(const PairFrame<T>& frame, const PointCloud& cloud, const ContactSettings<T>& settings, int pair,
                       ModeHash& hash) {
  for_contact_points<false, T>(frame, cloud, settings, [&](const ContactPack<T>& t) {
    PointForce<Pack<T>> force;
    point_force<false>(t.law, t.at, t.v, t.e, t.has_anchor, force);
    const auto normal_force = dot(force.force, t.at.n);
    t.for_each_active([&](int k, int i) {
      hash.add((static_cast<std::uint64_t>(pair) << 32) + static_cast<std::uint64_t>(i));
      hash.add(face_code<T>(lane3<T>(t.at.n, k), t.at.form != HessianForm::zero) * 16 +
               (lane(t.at.d, k) < T(-1e-6) ? 8 : 0) + (is_set(force.sliding, k) ? 4 : 0) +
               (is_set(t.has_anchor, k) ? 2 : 0) + (lane(normal_force, k) > T(0) ? 0 : 1));
    });
  });
}

template <class T>
void add_friction_mode(const JointParams<T>& p, const T& speed, ModeHash& hash) {
  if (p.frictionloss != T(0)) hash.add(speed > T(friction_creep) ? 1 : speed < T(-friction_creep) ? 2 : 0);
}
template <class T>
void add_limit_mode(const JointParams<T>& p, const T& position, const T& speed, ModeHash& hash) {
  const LimitForce<T> limit = limit_force<T>(p, position, speed);
  hash.add(limit.force > T(0) ? 1 : limit.force < T(0) ? 2 : 0);
}

// Adds which controls and actuator forces are clipped, the modes of dry friction, and the limits that are active.
template <class T>
void add_joint_modes(const Model& m, const T* params, const T* q, const T* v, const T* u, ModeHash& hash) {
  for (std::size_t a = 0; a < m.actuators.size(); ++a) {
    const Actuator& actuator = m.actuators[a];
    const Transmission<T> at = transmission<T>(m, actuator, q, v);
    hash.add(static_cast<std::uint64_t>(actuator_force<T>(actuator, actuator.params.in(params), u[a], at).clipped));
  }
  for (const Tendon& tendon : m.tendons) {
    const JointParams<T>& p = tendon.params.in(params);
    const Transmission<T> at = tendon_motion<T>(tendon, q, v);
    add_friction_mode(p, at.speed, hash);
    add_limit_mode(p, at.position, at.speed, hash);
  }
  for (const Joint& joint : m.joints) {
    const JointParams<T>& p = joint.params.in(params);
    for (int k = joint.v; k < joint.v + joint.dofs; ++k) add_friction_mode(p, v[k], hash);
    if (!joint.has_quaternion()) add_limit_mode(p, q[joint.q], v[joint.v], hash);
  }
}

// Signature of the step that ended in (q, v), with the anchors from before it. Markers are included where `markers` is
// true and where they have anchors.
template <class T>
std::uint64_t contact_mode_signature(const Model& m, const T* params, const T* q, const T* v, const V3<T>* anchors,
                                     const std::uint8_t* anchored, const T* u, bool markers, Workspace<T>& w) {
  ModeHash hash;
  forward_state<true, T>(m, params, q, nullptr, v, w);
  int pair = 0;
  for (const Contact& contact : m.contacts) {
    const PointSet& set = m.point_sets[contact.points];
    add_contact_modes<T>(pair_frame<T>(params, set.mount, m.shapes[contact.shape], w), set.cloud,
                         contact_settings<T>(m, contact, params, anchors, anchored), ++pair, hash);
  }
  for (const Pad& pad : m.pads) {
    for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
      ++pair;
      if (!markers && pad.anchor < 0) continue;
      add_contact_modes<T>(pair_frame<T>(params, pad.mount, m.shapes[pad.shapes[s]], w), pad.cloud,
                           contact_settings<T>(pad, s, params, anchors, anchored), pair, hash);
    }
  }
  add_joint_modes<T>(m, params, q, v, u, hash);
  return hash.value();
}

}  // namespace gelflow
