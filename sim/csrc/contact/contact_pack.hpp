// One SIMD pack of contact points (contact_point_loops.hpp: the loops over packs), and the evaluation of their kinematics
// and contact-law coefficients.
#pragma once

#include <bit>

#include "contact/contact_law.hpp"
#include "contact/contact_settings.hpp"
#include "geometry/pair_frame.hpp"

namespace gelflow {

// Points of one pack in the shape's frame.
template <class T>
struct ContactPack {
  using P = Pack<T>;
  int first = 0;               // index of the first point in the cloud, or among the candidates
  const int* index = nullptr;  // indices in the cloud; null where the points are consecutive there
  Mask<P> active;              // the point is in contact
  PointLaw<P> law;             // coefficients, weighted; zero if the point is not active
  Distance<P> at;
  Vec3<P> center, x;   // material point (the centre of a rolling sphere); contact point
  Vec3<P> v;           // velocity relative to the shape
  Mask<P> has_anchor;  // elastic law: the point was in contact before
  Vec3<P> anchor, e;   // elastic law: X and e = x − X

  // Calls f(lane, index in the cloud) for the active points.
  template <class F>
  GELFLOW_INLINE void for_each_active(F&& f) const {
    for (unsigned remaining = bits(active); remaining != 0; remaining &= remaining - 1) {
      const int k = std::countr_zero(remaining);
      f(k, index != nullptr ? index[k] : first + k);
    }
  }
};

// Quantities common to all points of a pair, broadcast to packs.
template <class T>
struct PairConstants {
  using P = Pack<T>;
  Mat3<P> rotation;
  Vec3<P> offset;   // to the contact point: the lowest one of a rolling sphere, which collides with planes only
  P center_height;  // of the rolling sphere's centre above the contact point
  Vec3<P> angular, linear;
  P kn, kt, mu, kd, ks, rounding;
  DampingLaw damping;
  bool elastic;

  PairConstants(const PairFrame<T>& frame, const ContactSettings<T>& settings)
      : rotation(broadcast<P>(frame.rotation)),
        offset(broadcast<P>(V3<T>(frame.offset - V3<T>(T(0), T(0), settings.rolling_radius)))),
        center_height(settings.rolling_radius),
        angular(broadcast<P>(frame.angular)),
        linear(broadcast<P>(frame.linear)),
        kn(settings.params.kn),
        kt(T(T(settings.continuation) * settings.params.kt)),
        mu(settings.params.mu),
        kd(settings.params.kd),
        ks(T(T(settings.continuation) * settings.params.ks)),
        rounding(T(4 * real_part(Eigen::NumTraits<T>::epsilon()))),
        damping(settings.damping),
        elastic(settings.law == FrictionLaw::elastic) {}

  GELFLOW_INLINE Vec3<P> to_shape_frame(const Vec3<P>& local) const {
    const auto along = [&](int a) GELFLOW_LOOP_BODY {
      const Vec3<P>& row = rotation.row[a];
      return offset[a] + row.x * local.x + row.y * local.y + row.z * local.z;
    };
    return {along(0), along(1), along(2)};
  }
  GELFLOW_INLINE Vec3<P> velocity(const Vec3<P>& x) const {
    return {linear.x + angular.y * x.z - angular.z * x.y, linear.y + angular.z * x.x - angular.x * x.z,
            linear.z + angular.x * x.y - angular.y * x.x};
  }
};

// Fills velocity and contact-law coefficients of points whose positions, distances and anchors are set; `weight` is 0
// where a point is not active.
template <bool elastic, class T>
GELFLOW_INLINE void eval_contact(const PairConstants<T>& pair, const Pack<T>& weight, ContactPack<T>& t) {
  t.law.kn = weight * pair.kn;
  t.law.kt = weight * pair.kt;
  t.law.mu = pair.mu;
  t.law.kd = weight * pair.kd;
  t.law.damping = pair.damping;
  t.law.elastic = elastic;
  t.v = pair.velocity(t.x);
  if constexpr (elastic) {
    t.law.ks = weight * pair.ks;
    t.law.rounding = pair.rounding * (abs(t.x.x) + abs(t.x.y) + abs(t.x.z));
    t.e = select3<Pack<T>>(t.has_anchor, t.x - t.anchor, zero3<Pack<T>>());
  }
}

}  // namespace gelflow
