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

  GELFLOW_INLINE V3<T> point(const V3<double>& local) const { return rotation * local.template cast<T>() + offset; }
  GELFLOW_INLINE V3<T> velocity(const V3<T>& x) const { return linear + cross<T>(angular, x); }
  GELFLOW_INLINE V6<T> motion(const V6<T>& in_world) const {
    const V3<T> w = top(in_world), v = bottom(in_world);
    return stack<T>(to_world.transpose() * w, to_world.transpose() * (v + cross<T>(w, origin)));
  }
};

template <class T>
PairFrame<T> pair_frame(const Model& m, const T* params, int first, const Shape& shape, const Workspace<T>& w) {
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
  const V6<T> local = f.motion(twist);
  f.angular = top(local);
  f.linear = bottom(local);
  (void)m;
  return f;
}

// Calls visit(i) for every point that may be inside the shape, skip(begin, end) for runs that can not be.
template <class T, class Visit, class Skip>
GELFLOW_INLINE void for_near_points(const PairFrame<T>& f, const PointCloud& cloud, Visit&& visit, Skip&& skip) {
  for (const auto& group : cloud.groups) {
    const int first = cloud.leaves[group.begin].begin, last = cloud.leaves[group.end - 1].end;
    if (cloud.groups.size() > 1 && distance_only<T>(f.kind, f.size, f.point(group.center)) >= T(group.radius)) {
      skip(first, last);
      continue;
    }
    for (int l = group.begin; l < group.end; ++l) {
      const auto& leaf = cloud.leaves[l];
      if (cloud.points.size() > 1 && distance_only<T>(f.kind, f.size, f.point(leaf.center)) >= T(leaf.radius)) {
        skip(leaf.begin, leaf.end);
        continue;
      }
      for (int i = leaf.begin; i < leaf.end; ++i) visit(i);
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

template <class T>
void pair_columns(const PairDofs& pair, int first, const PairFrame<T>& f, const Workspace<T>& w, PairColumns<T>& c) {
  c.n = static_cast<int>(pair.dof.size());
  const V6<T> twist = first == world ? V6<T>(V6<T>::Zero()) : w.twist[first];
  for (int i = 0; i < c.n; ++i) {
    const int j = pair.dof[i];
    const T sign = pair.first[i] ? T(1) : T(-1);
    c.s[i] = sign * f.motion(w.axis[j]);
    c.y[i] = sign * f.motion(cross_motion<T>(w.axis[j], V6<T>(twist - w.twist_before[j])));
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
