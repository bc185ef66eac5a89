// One ordered pair: points of a first body in the frame of a shape on a second body; and how what is felt there acts
// on the joints.
//
// In the shape's frame everything depends on the relative pose and the relative twist V = V₁ − V₂ only. For the dofs
// that move one of the two bodies (sign s = +1 the first, −1 the second), written in the shape's frame,
//     displacement of the first body relative to the second   δξ = Σ s_j S_j δq_j
//     change of the relative twist                            δV = Σ s_j (Y_j δq_j + S_j δv_j),  Y_j = S_j × (V₁ − V_before(j))
//     ∂S_k/∂q_j · W = c_kj S_k · (S_j ×* W)   with c = −1 if both move the first body and j carries k, +1 if k moves the
//                     first and j the second, +1 if both move the second and j does not carry k, else 0.
#pragma once

#include "contact_law.hpp"
#include "kinematics.hpp"

namespace gelflow {

template <class T>
struct PairFrame {
  M3<T> rotation;         // first body → shape
  V3<T> offset;           // origin of the first body, in the shape's frame
  M3<T> to_world;         // shape → world
  V3<T> origin;           // of the shape, in the world
  V3<T> angular, linear;  // V, at the shape's origin
  const T* size;
  ShapeKind kind;
  V3<T> local;    // in the first body's frame: a sphere's centre, a plane's normal
  T local_level;  // height of the first body's origin above a plane

  // Whether a ball of this radius about a point of the first body may reach into the shape. May say yes to a ball that
  // just does not; costs less than the point's place in the shape's frame.
  GELFLOW_INLINE bool may_reach(const V3<double>& center, double radius) const {
    constexpr double slack = 1e-6;  // [m], above the rounding of single precision
    const T reach = T(radius + slack);
    const V3<T> c = center.template cast<T>();
    if (kind == ShapeKind::sphere) {
      const T limit = size[0] + reach;
      return (c - local).squaredNorm() < limit * limit;
    }
    if (kind == ShapeKind::plane) return local.dot(c) + local_level < reach;
    return distance_only<T>(kind, size, point(center)) < reach;
  }

  GELFLOW_INLINE V3<T> point(const V3<double>& local) const { return rotation * local.template cast<T>() + offset; }
  GELFLOW_INLINE V3<T> velocity(const V3<T>& x) const { return linear + cross<T>(angular, x); }
  GELFLOW_INLINE V6<T> motion(const V6<T>& in_world) const {
    const V3<T> w = top(in_world), v = bottom(in_world);
    return stack<T>(to_world.transpose() * w, to_world.transpose() * (v + cross<T>(w, origin)));
  }
};

template <class T>
PairFrame<T> pair_frame(const T* params, int first, const Shape& shape, const Workspace<T>& w) {
  PairFrame<T> f;
  f.kind = shape.kind;
  f.size = params + shape.size;
  f.to_world = shape.rotation.template cast<T>();
  f.origin = shape.pos.template cast<T>();
  V6<T> twist = first == world ? V6<T>(V6<T>::Zero()) : w.twist[first];
  if (shape.body != world) {
    f.origin = (w.position[shape.body] + w.rotation[shape.body] * f.origin).eval();
    f.to_world = (w.rotation[shape.body] * f.to_world).eval();
    twist -= w.twist[shape.body];
  }
  const M3<T> first_rotation = first == world ? M3<T>(M3<T>::Identity()) : w.rotation[first];
  const V3<T> first_position = first == world ? V3<T>(V3<T>::Zero()) : w.position[first];
  f.rotation = f.to_world.transpose() * first_rotation;
  f.offset = f.to_world.transpose() * (first_position - f.origin);
  f.local =
      shape.kind == ShapeKind::plane ? V3<T>(f.rotation.transpose().col(2)) : V3<T>(f.rotation.transpose() * -f.offset);
  f.local_level = f.offset[2];
  const V6<T> local = f.motion(twist);
  f.angular = top(local);
  f.linear = bottom(local);
  return f;
}

// Calls visit(i) for every point that may be inside the shape grown by `margin`, skip(begin, end) for runs that can not.
template <class T, class Visit, class Skip>
GELFLOW_INLINE void for_near_points(const PairFrame<T>& f, const PointCloud& cloud, double margin, Visit&& visit,
                                    Skip&& skip) {
  for (const auto& group : cloud.groups) {
    if (!f.may_reach(group.center, group.radius + margin)) {
      skip(cloud.leaves[group.begin].begin, cloud.leaves[group.end - 1].end);
      continue;
    }
    for (int l = group.begin; l < group.end; ++l) {
      const auto& leaf = cloud.leaves[l];
      if (!f.may_reach(leaf.center, leaf.radius + margin)) {
        skip(leaf.begin, leaf.end);
        continue;
      }
      for (int i = leaf.begin; i < leaf.end; ++i) {
        if (f.may_reach(cloud.points[i], margin)) {
          visit(i);
        } else {
          skip(i, i + 1);
        }
      }
    }
  }
}

template <class T>
PointLaw<T> law_numbers(const T* p, FrictionLaw law, DampingLaw damping, const T& h) {
  return {p[0], p[1], p[2], p[3], p[4], damping, law == FrictionLaw::elastic, false, h};
}
template <class T>
PointLaw<T> weighted(PointLaw<T> law, double weight) {
  const T w = T(weight);
  law.kn *= w;
  law.kt *= w;
  law.kd *= w;
  law.ks *= w;
  return law;
}

// The dofs of a pair in the shape's frame, signs applied: δξ = Σ S_j δq_j, δV = Σ (Y_j δq_j + S_j δv_j).
template <class T>
struct PairColumns {
  static constexpr int most = 64;
  int n = 0;
  V6<T> s[most], y[most];
};

template <bool derivatives, class T>
void pair_columns(const PairDofs& pair, int first, const PairFrame<T>& f, const Workspace<T>& w, PairColumns<T>& c) {
  c.n = static_cast<int>(pair.dof.size());
  for (int i = 0; i < c.n; ++i) c.s[i] = (pair.first[i] ? T(1) : T(-1)) * f.motion(w.axis[pair.dof[i]]);
  if constexpr (derivatives) {
    const V6<T> twist = f.motion(first == world ? V6<T>(V6<T>::Zero()) : w.twist[first]);
    for (int i = 0; i < c.n; ++i) {
      c.y[i] = cross_motion<T>(c.s[i], V6<T>(twist - f.motion(w.twist_before[pair.dof[i]])));
    }
  }
}

// Gradients with respect to the relative pose and twist, carried to the joints.
template <class T>
void pull_back(const PairDofs& pair, const PairColumns<T>& c, const V6<T>& by_pose, const V6<T>& by_twist, VX<T>& by_q,
               VX<T>& by_v) {
  for (int i = 0; i < c.n; ++i) {
    by_q[pair.dof[i]] += c.s[i].dot(by_pose) + c.y[i].dot(by_twist);
    by_v[pair.dof[i]] += c.s[i].dot(by_twist);
  }
}

}  // namespace gelflow
