// Relative pose and twist of a pair: the points of a first body in the frame of a shape on a second body. Distances and
// forces depend on the relative pose and the relative twist V = V₁ − V₂ only.
#pragma once

#include <type_traits>

#include "dynamics/kinematics.hpp"
#include "geometry/distance_bound.hpp"

namespace gelflow {

template <class T>
struct PairFrame {
  M3<T> rotation;         // first body → shape
  V3<T> offset;           // origin of the first body, in the shape's frame
  M3<T> to_world;         // shape → world
  V3<T> origin;           // of the shape, in the world
  V3<T> angular, linear;  // V, at the shape's origin
  const T* size;
  const DistanceGrid* grid;
  ShapeKind kind;
  V3<T> local;     // in the first body's frame: a sphere's centre, a plane's normal
  T plane_height;  // height of the first body's origin above a plane
  // Scaled points (`rotation` includes the scale):
  bool scaled;
  T max_scale;        // the largest of the three
  V3<T> area_growth;  // relative increase of areas across x, y, z

  // Conservative test whether points of the first body may be nearer to the shape than `reach`; cheaper than their
  // positions in the shape's frame.
  template <bool scaled, class P>
  GELFLOW_INLINE Mask<P> may_reach(const Vec3<P>& c, const P& reach) const {
    if (!scaled && kind == ShapeKind::sphere) {
      const Vec3<P> gap = c - broadcast<P>(local);
      const P limit = P(size[0]) + reach;
      return dot(gap, gap) < limit * limit;
    }
    if (kind == ShapeKind::plane) return dot(broadcast<P>(local), c) + P(plane_height) < reach;
    return distance_bound<P, T>(kind, size, grid, broadcast<P>(rotation) * c + broadcast<P>(offset)) < reach;
  }

  // Not finite where a parameter is not: no point is active then, which must not be mistaken for no contact.
  T finiteness_probe() const {
    const bool rounded = kind == ShapeKind::rounded_box || kind == ShapeKind::rounded_cylinder;
    return offset[0] + offset[1] + offset[2] + size[0] + size[1] + size[2] + (rounded ? size[3] : T(0));
  }

  GELFLOW_INLINE V6<T> motion(const V6<T>& in_world) const {
    const V3<T> w = top(in_world), v = bottom(in_world);
    return stack<T>(to_world.transpose() * w, to_world.transpose() * (v + cross<T>(w, origin)));
  }
};

// Whether values differ from the nominal ones; always true for values with derivatives.
template <class T>
GELFLOW_INLINE bool differs_from_nominal(const V3<T>& numbers, const V3<double>& nominal) {
  if constexpr (!std::is_floating_point_v<T>) return true;
  return numbers[0] != T(nominal[0]) || numbers[1] != T(nominal[1]) || numbers[2] != T(nominal[2]);
}

template <class T>
M3<T> rotation_exp(const V3<T>& turn) {
  return rotation_of<T>(quaternion_exp<T>(turn));
}

// With R, p the nominal frame in the body and the parameters position p', rotation φ and scale S, a point x of the body
// moves to
//     x' = p' + R exp(φ) S Rᵀ (x − p) = A x + b,    A − 1 = R (exp(φ) S − 1) Rᵀ,    b = (p' − p) − (A − 1) p
// (without rounding errors where nothing moves). Composes the body's pose with (A, b).
template <class T>
__attribute__((noinline)) void move_mount(const T* params, const Mount& mount, M3<PositionScalar<T>>& rotation,
                                          V3<PositionScalar<T>>& position, PairFrame<T>& f) {
  using Scalar = PositionScalar<T>;
  const M3<Scalar> r = mount.rotation.template cast<Scalar>();
  const V3<Scalar> p = mount.pos.template cast<Scalar>();
  const PoseParams<T>& pose = mount.pose.in(params);
  M3<Scalar> change = as<Scalar>(rotation_exp<T>(pose.turn));
  if (mount.has_scale()) {
    const V3<T>& s = mount.scale.in(params).scale;
    for (int a = 0; a < 3; ++a) change.col(a) *= Scalar(s[a]);
    f.scaled = !std::is_floating_point_v<T> || differs_from_nominal<T>(s, V3<double>::Ones());
    f.max_scale = std::max({s[0], s[1], s[2]});
    f.area_growth = V3<T>(s[1] * s[2] - T(1), s[2] * s[0] - T(1), s[0] * s[1] - T(1));
  }
  change -= M3<Scalar>::Identity();
  change = (r * change * r.transpose()).eval();
  position += rotation * V3<Scalar>(as<Scalar>(pose.pos) - p - change * p);
  rotation += (rotation * change).eval();
}

template <class T>
PairFrame<T> pair_frame(const T* params, const Mount& mount, const Shape& shape, const Workspace<T>& w) {
  using Scalar = PositionScalar<T>;
  PairFrame<T> f;
  const int first = mount.body;
  f.kind = shape.kind;
  f.size = params + shape.size.offset;
  f.grid = shape.grid.get();
  M3<Scalar> to_world = shape.rotation.template cast<Scalar>();
  const PoseParams<T>& shape_pose = shape.pose.in(params);
  if (differs_from_nominal<T>(shape_pose.turn, V3<double>::Zero())) {
    to_world = (to_world * as<Scalar>(rotation_exp<T>(shape_pose.turn))).eval();
  }
  V3<Scalar> origin = as<Scalar>(shape_pose.pos);
  V6<T> twist = first == world ? V6<T>(V6<T>::Zero()) : w.twist[first];
  if (shape.body != world) {
    origin = (w.position[shape.body] + w.rotation[shape.body] * origin).eval();
    to_world = (w.rotation[shape.body] * to_world).eval();
    twist -= w.twist[shape.body];
  }
  M3<Scalar> first_rotation = first == world ? M3<Scalar>(M3<Scalar>::Identity()) : w.rotation[first];
  V3<Scalar> first_position = first == world ? V3<Scalar>(V3<Scalar>::Zero()) : w.position[first];
  f.scaled = false;
  const PoseParams<T>& pose = mount.pose.in(params);
  if (differs_from_nominal<T>(pose.pos, mount.pos) || differs_from_nominal<T>(pose.turn, V3<double>::Zero()) ||
      (mount.has_scale() && differs_from_nominal<T>(mount.scale.in(params).scale, V3<double>::Ones()))) {
    move_mount<T>(params, mount, first_rotation, first_position, f);
  }
  const M3<Scalar> rotation = to_world.transpose() * first_rotation;
  const V3<Scalar> offset = to_world.transpose() * (first_position - origin);
  f.to_world = as<T>(to_world);
  f.origin = as<T>(origin);
  f.rotation = as<T>(rotation);
  f.offset = as<T>(offset);
  f.local =
      shape.kind == ShapeKind::plane ? V3<T>(f.rotation.transpose().col(2)) : V3<T>(f.rotation.transpose() * -f.offset);
  f.plane_height = f.offset[2];
  const V6<T> local = f.motion(twist);
  f.angular = top(local);
  f.linear = bottom(local);
  return f;
}

}  // namespace gelflow
