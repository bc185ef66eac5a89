// Contact Jacobian of a pair: from generalized velocities to the relative twist of its bodies.
//
// For the dofs that move one of the two bodies and not the other (sign s = +1 the first, −1 the second), written in the
// shape's frame,
//     displacement of the first body relative to the second   δξ = Σ s_j S_j δq_j
//     change of the relative twist                            δV = Σ s_j (Y_j δq_j + S_j δv_j),  Y_j = S_j × (V₁ − V_before(j))
//     ∂S_k/∂q_j · W = c_kj S_k · (S_j ×* W)   with c = −1 if both move the first body and j is an ancestor of k, +1 if k
//                     moves the first and j the second, +1 if both move the second and j is no ancestor of k, else 0.
// Columns are stored in packs of consecutive dofs; columns of dofs that are not part of the pair are zero.
#pragma once

#include "geometry/pair_frame.hpp"

namespace gelflow {

// A pack of motion vectors, transformed from the world to the shape's frame.
template <class T>
struct PackedMotion {
  using P = Pack<T>;
  Vec3<P> angular, linear;
};
template <class T>
GELFLOW_INLINE PackedMotion<T> packed_motion(const PairFrame<T>& f, const SixRows<T>& x, int at) {
  using P = Pack<T>;
  const Vec3<P> w{load<P>(x.row(0) + at), load<P>(x.row(1) + at), load<P>(x.row(2) + at)};
  const Vec3<P> v{load<P>(x.row(3) + at), load<P>(x.row(4) + at), load<P>(x.row(5) + at)};
  const Mat3<P> to_world = broadcast<P>(f.to_world);
  return {transposed_times(to_world, w), transposed_times(to_world, v + cross(w, broadcast<P>(f.origin)))};
}

template <class T>
void contact_jacobian(const PairDofs& pair, int first, const PairFrame<T>& f, Workspace<T>& w) {
  using P = Pack<T>;
  ContactJacobian<T>& c = w.jacobian;
  c.dofs = &pair.packed<pack_width<T>>();
  c.n = static_cast<int>(c.dofs->dof.size());
  const V6<T> twist = f.motion(first == world ? V6<T>(V6<T>::Zero()) : w.twist[first]);
  for (int i = 0; i < c.n; i += pack_width<T>) {
    const int at = c.dofs->start[i / pack_width<T>];
    c.matrix_column[i / pack_width<T>] = w.layout.column()[at];
    const P sign = load<P>(&c.dofs->sign[i]);
    PackedMotion<T> s = packed_motion<T>(f, w.axis, at);
    s.angular = sign * s.angular;
    s.linear = sign * s.linear;
    for (int a = 0; a < 3; ++a) {
      store(s.angular[a], c.s.at(i, a));
      store(s.linear[a], c.s.at(i, 3 + a));
    }
    const PackedMotion<T> before = packed_motion<T>(f, w.twist_before, at);
    const Vec3<P> angular = broadcast<P>(V3<T>(top(twist))) - before.angular;
    const Vec3<P> linear = broadcast<P>(V3<T>(bottom(twist))) - before.linear;
    const Vec3<P> y_angular = cross(s.angular, angular), y_linear = cross(s.angular, linear) + cross(s.linear, angular);
    for (int a = 0; a < 3; ++a) {
      store(y_angular[a], c.y.at(i, a));
      store(y_linear[a], c.y.at(i, 3 + a));
    }
  }
}

// Carries gradients with respect to the relative pose and twist to the generalized coordinates.
template <class T>
void contact_jacobian_vjp(const ContactJacobian<T>& c, const V6<T>& grad_pose, const V6<T>& grad_twist, VX<T>& grad_q,
                          VX<T>& grad_v) {
  for (int i = 0; i < c.n; ++i) {
    const int dof = c.dofs->dof[i];
    if (dof < 0) continue;
    const V6<T> s = c.s[i], y = c.y[i];
    grad_q[dof] += s.dot(grad_pose) + y.dot(grad_twist);
    grad_v[dof] += s.dot(grad_twist);
  }
}

}  // namespace gelflow
