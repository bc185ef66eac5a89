// One ordered pair: the points of a first body, seen from the frame of a shape on a second body. There everything depends
// on the relative pose and the relative twist V = V₁ − V₂ only.
#pragma once

#include <type_traits>

#include "contact/contact_law.hpp"
#include "dynamics/kinematics.hpp"

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
  V3<T> local;    // in the first body's frame: a sphere's centre, a plane's normal
  T local_level;  // height of the first body's origin above a plane
  // Where the points are scaled (then `rotation` holds that too):
  bool scaled;
  T stretch;       // the largest scale
  V3<T> enlarged;  // by how much faces across x, y, z are larger, less 1

  // Whether points of the first body may be nearer to the shape than `reach`. May say yes to one that just is not; costs
  // less than the points' places in the shape's frame.
  template <bool scaled, class L>
  GELFLOW_INLINE Mask<L> may_reach(const Vec3<L>& c, const L& reach) const {
    if (!scaled && kind == ShapeKind::sphere) {
      const Vec3<L> gap = c - spread<L>(local);
      const L limit = L(size[0]) + reach;
      return dot(gap, gap) < limit * limit;
    }
    if (kind == ShapeKind::plane) return dot(spread<L>(local), c) + L(local_level) < reach;
    return distance_bound<L, T>(kind, size, grid, spread<L>(rotation) * c + spread<L>(offset)) < reach;
  }

  // Not finite where a parameter is not: then no point touches, and that must not pass for no contact.
  T check() const {
    const bool rounded = kind == ShapeKind::rounded_box || kind == ShapeKind::rounded_cylinder;
    return offset[0] + offset[1] + offset[2] + size[0] + size[1] + size[2] + (rounded ? size[3] : T(0));
  }

  GELFLOW_INLINE V6<T> motion(const V6<T>& in_world) const {
    const V3<T> w = top(in_world), v = bottom(in_world);
    return stack<T>(to_world.transpose() * w, to_world.transpose() * (v + cross<T>(w, origin)));
  }
};

// Whether these numbers are others than the nominal ones. Numbers that carry derivatives always are.
template <class T>
GELFLOW_INLINE bool differs(const T* numbers, const V3<double>& nominal) {
  if constexpr (!std::is_floating_point_v<T>) return true;
  return numbers[0] != T(nominal[0]) || numbers[1] != T(nominal[1]) || numbers[2] != T(nominal[2]);
}

template <class T>
M3<T> turn_of(const T* turn) {
  return rotation_of<T>(quaternion_exp<T>(vec3(turn)));
}

// With R, p the nominal frame in the body and Params' place p', turn φ, scale S, a point x of the body moves to
//     x' = p' + R exp(φ) S Rᵀ (x − p) = A x + b,    A − 1 = R (exp(φ) S − 1) Rᵀ,    b = (p' − p) − (A − 1) p
// (written so that nothing is rounded where nothing moves): the body's pose ∘ (A, b) takes the body's place.
template <class T>
__attribute__((noinline)) void move_mount(const T* place, const Mount& mount, M3<Place<T>>& rotation,
                                          V3<Place<T>>& position, PairFrame<T>& f) {
  using P = Place<T>;
  const M3<P> r = mount.rotation.template cast<P>();
  const V3<P> p = mount.pos.template cast<P>();
  M3<P> change = as<P>(turn_of<T>(place + 3));
  if (mount.scales) {
    const T* s = place + 6;
    for (int a = 0; a < 3; ++a) change.col(a) *= P(s[a]);
    f.scaled = !std::is_floating_point_v<T> || differs<T>(s, V3<double>::Ones());
    f.stretch = std::max({s[0], s[1], s[2]});
    f.enlarged = V3<T>(s[1] * s[2] - T(1), s[2] * s[0] - T(1), s[0] * s[1] - T(1));
  }
  change -= M3<P>::Identity();
  change = (r * change * r.transpose()).eval();
  position += rotation * V3<P>(as<P>(vec3(place)) - p - change * p);
  rotation += (rotation * change).eval();
}

template <class T>
PairFrame<T> pair_frame(const T* params, const Mount& mount, const Shape& shape, const Workspace<T>& w) {
  using P = Place<T>;
  PairFrame<T> f;
  const int first = mount.body;
  f.kind = shape.kind;
  f.size = params + shape.size;
  f.grid = shape.grid.get();
  M3<P> to_world = shape.rotation.template cast<P>();
  if (differs<T>(params + shape.place + 3, V3<double>::Zero())) {
    to_world = (to_world * as<P>(turn_of<T>(params + shape.place + 3))).eval();
  }
  V3<P> origin = as<P>(vec3(params + shape.place));
  V6<T> twist = first == world ? V6<T>(V6<T>::Zero()) : w.twist[first];
  if (shape.body != world) {
    origin = (w.position[shape.body] + w.rotation[shape.body] * origin).eval();
    to_world = (w.rotation[shape.body] * to_world).eval();
    twist -= w.twist[shape.body];
  }
  M3<P> first_rotation = first == world ? M3<P>(M3<P>::Identity()) : w.rotation[first];
  V3<P> first_position = first == world ? V3<P>(V3<P>::Zero()) : w.position[first];
  f.scaled = false;
  const T* place = params + mount.place;
  if (differs<T>(place, mount.pos) || differs<T>(place + 3, V3<double>::Zero()) ||
      (mount.scales && differs<T>(place + 6, V3<double>::Ones()))) {
    move_mount<T>(place, mount, first_rotation, first_position, f);
  }
  const M3<P> rotation = to_world.transpose() * first_rotation;
  const V3<P> offset = to_world.transpose() * (first_position - origin);
  f.to_world = as<T>(to_world);
  f.origin = as<T>(origin);
  f.rotation = as<T>(rotation);
  f.offset = as<T>(offset);
  f.local =
      shape.kind == ShapeKind::plane ? V3<T>(f.rotation.transpose().col(2)) : V3<T>(f.rotation.transpose() * -f.offset);
  f.local_level = f.offset[2];
  const V6<T> local = f.motion(twist);
  f.angular = top(local);
  f.linear = bottom(local);
  return f;
}

}  // namespace gelflow
