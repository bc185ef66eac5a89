// Contact law and parameters of the points of one pair: of a contact, or of a pad's markers and a shape.
#pragma once

#include "model/workspace.hpp"

namespace gelflow {

template <class T>
struct ContactSettings {
  const ContactParams<T>& params;
  FrictionLaw law;
  DampingLaw damping;
  T rolling_radius;              // of a sphere whose lowest point makes contact; 0: the points themselves do
  const V3<T>* anchors;          // of this cloud against this shape
  const std::uint8_t* anchored;  // both unused under the viscous law
  double continuation = 1;       // factor of k_t and k_s (newton.hpp)
  T step_length = T(0);          // h, where a step is taken [s]
};

template <class T>
ContactSettings<T> contact_settings(const Model& m, const Contact& contact, const T* params, const V3<T>* anchors,
                                    const std::uint8_t* anchored, const T& step_length = T(0)) {
  const int slot = contact.anchor < 0 ? 0 : contact.anchor;
  const PointSet& set = m.point_sets[contact.points];
  // The first scale scales a sphere's radius; point sets without a radius may have no scales (pads with contacts).
  const T radius = set.radius > 0 ? T(T(set.radius) * set.mount.scale.in(params).scale[0]) : T(0);
  return {contact.params.in(params), contact.law, contact.damping, radius, anchors + slot,
          anchored + slot,           1,           step_length};
}

// The markers of a pad against its shape number s.
template <class T>
ContactSettings<T> contact_settings(const Pad& pad, std::size_t s, const T* params, const V3<T>* anchors,
                                    const std::uint8_t* anchored, const T& step_length = T(0)) {
  const std::size_t slot = pad.anchor < 0 ? 0 : pad.anchor + s * pad.cloud.size();
  return {
      pad.params.in(params), pad.law, DampingLaw::hunt_crossley, T(0), anchors + slot, anchored + slot, 1, step_length};
}

}  // namespace gelflow
