// Forward kinematics of positions, velocities and accelerations, and the operations q ⊕ h v of the configuration space.
//
// Joints act in order on the body's frame, as in MuJoCo. A free joint is three slides along the world's axes followed
// by a ball: velocities are (linear in the world frame, angular in the body frame). A ball's velocity is angular, in the
// frame that it rotates. With S_k the motion subspace of dof k (world frame, at the world's origin), a displacement of
// dof j moves its subtree rigidly:
//     ∂S_k/∂q_j = S_j × S_k   for each k in the subtree or the group of j (`Model::is_ancestor`).
// The rest of the core needs no other derivative of kinematics.
#pragma once

#include "model/workspace.hpp"

namespace gelflow {

template <class T>
V3<T> vec3(const T* p) {
  return {p[0], p[1], p[2]};
}

template <class T>
V4<T> vec4(const T* p) {
  return {p[0], p[1], p[2], p[3]};
}

// q[i] plus its rounding residual (StateView::q_rounding). The residual is ignored where it is not smaller than the
// rounding of q[i]: then q was written since.
template <class T>
PositionScalar<T> position_with_rounding(const T* q, const T* q_rounding, int i) {
  if (std::is_same_v<T, PositionScalar<T>> || q_rounding == nullptr) return PositionScalar<T>(q[i]);
  const PositionScalar<T> sum = PositionScalar<T>(q[i]) + PositionScalar<T>(q_rounding[i]);
  return T(sum) == q[i] ? sum : PositionScalar<T>(q[i]);
}

// Sets the axis S_k from its angular and linear parts.
template <class T, class Scalar>
GELFLOW_INLINE void set_axis(Workspace<T>& w, int k, const V3<Scalar>& angular, const V3<Scalar>& linear) {
  w.axis.set(k, as<T>(stack<Scalar>(angular, linear)));
}

// Axes of the three rotational dofs from k on: the axes of the rotated frame, through a point.
template <class T, class Scalar>
GELFLOW_INLINE void set_rotation_axes(Workspace<T>& w, int k, const M3<Scalar>& rotation, const V3<Scalar>& point) {
  for (int a = 0; a < 3; ++a) {
    const V3<Scalar> direction = rotation.col(a);
    set_axis<T, Scalar>(w, k + a, direction, cross<Scalar>(point, direction));
  }
}

// The rotation of a quaternion of any length. One of unit length is taken as it is: its rounding stays.
template <class Scalar>
GELFLOW_INLINE M3<Scalar> rotation_of_any(const Scalar* value) {
  using std::abs;
  using std::sqrt;
  const V4<Scalar> q = vec4(value);
  const Scalar squared = q.squaredNorm();
  constexpr double rounding = 1e-6;
  if (abs(squared - Scalar(1)) <= Scalar(rounding)) return rotation_of<Scalar>(q);
  return rotation_of<Scalar>(q * (Scalar(1) / sqrt(squared)));
}

// Moves the body frame (r, p) by one joint, with positions `value`, and sets the joint's axes.
template <class T, class Scalar>
GELFLOW_INLINE void apply_joint(const Joint& joint, const Scalar* value, M3<Scalar>& r, V3<Scalar>& p,
                                Workspace<T>& w) {
  if (joint.type == JointType::free) {
    p = vec3(value);
    r = rotation_of_any<Scalar>(value + 3);
    for (int a = 0; a < 3; ++a) set_axis<T, Scalar>(w, joint.v + a, V3<Scalar>::Zero(), V3<Scalar>::Unit(a));
    set_rotation_axes<T, Scalar>(w, joint.v + 3, r, p);
    return;
  }
  if (joint.type == JointType::ball) {
    const V3<Scalar> offset = joint.pos.template cast<Scalar>();
    const V3<Scalar> anchor = p + r * offset;
    r = (r * rotation_of_any<Scalar>(value)).eval();
    p = anchor - r * offset;
    set_rotation_axes<T, Scalar>(w, joint.v, r, anchor);
    return;
  }
  const V3<Scalar> local = joint.axis.template cast<Scalar>();
  const V3<Scalar> direction = r * local;
  if (joint.type == JointType::slide) {
    set_axis<T, Scalar>(w, joint.v, V3<Scalar>::Zero(), direction);
    p += direction * (value[0] - Scalar(joint.ref));
    return;
  }
  const V3<Scalar> offset = joint.pos.template cast<Scalar>();
  const V3<Scalar> anchor = p + r * offset;
  set_axis<T, Scalar>(w, joint.v, direction, cross<Scalar>(anchor, direction));
  r = (r * axis_rotation<Scalar>(local, value[0] - Scalar(joint.ref))).eval();
  p = anchor - r * offset;
}

// Poses of all bodies and axes of all dofs at positions q.
template <class T>
void forward_positions(const Model& m, const T* params, const PositionScalar<T>* q, Workspace<T>& w) {
  using Scalar = PositionScalar<T>;
  for (std::size_t i = 0, bodies = m.bodies.size(); i < bodies; ++i) {
    const Body& body = m.bodies[i];
    M3<Scalar> r = body.rotation.template cast<Scalar>();
    V3<Scalar> p = as<Scalar>(body.params.in(params).pos);
    if (body.parent != world) {
      p = (w.position[body.parent] + w.rotation[body.parent] * p).eval();
      r = (w.rotation[body.parent] * r).eval();
    }
    for (int j = body.joint_begin; j < body.joint_end; ++j) {
      apply_joint<T, Scalar>(m.joints[j], q + m.joints[j].q, r, p, w);
    }
    w.rotation[i] = r;
    w.position[i] = p;
  }
}

// Twist of a free body. Its acceleration is computed in its own frame (free_body.hpp).
template <bool store_before, class T>
GELFLOW_INLINE void free_body_velocity(const Model& m, std::size_t i, const T* v, Workspace<T>& w) {
  const int k = m.joints[m.bodies[i].joint_begin].v;
  const V3<T> linear = vec3(v + k), angular = as<T>(w.rotation[i]) * vec3(v + k + 3);
  w.twist[i] = stack<T>(angular, linear + cross<T>(as<T>(w.position[i]), angular));
  if constexpr (store_before) {
    const V6<T> before = stack<T>(V3<T>::Zero(), linear);
    for (int g = k + 3; g < k + 6; ++g) w.twist_before.set(g, before);
  }
}

// Adds one group of dofs (k … end) to the twist and the acceleration of a body.
template <bool store_before, class T>
GELFLOW_INLINE void add_group_velocity(int k, int end, const T* v, const T* a, V6<T>& twist, V6<T>& acceleration,
                                       Workspace<T>& w) {
  const V6<T> before = twist;
  V6<T> own = V6<T>::Zero(), own_rate = own;
  for (int g = k; g < end; ++g) {
    const V6<T> axis = w.axis[g];
    own += axis * v[g];
    own_rate += axis * a[g];
  }
  twist += own;
  if constexpr (store_before) {
    for (int g = k; g < end; ++g) {
      w.twist_before.set(g, before);
      w.twist_after[g] = twist;
      w.acceleration_before[g] = acceleration;
    }
  }
  acceleration += own_rate + cross_motion<T>(before, own);
}

// Twists V and accelerations A of all bodies; gravity enters as an acceleration of the world. `store_before` also stores
// twist and acceleration before each dof and the twist after it, for derivatives; not for translations without a rotation
// before them (Model::translation_only), where these are not needed.
template <bool store_before, class T>
void forward_velocities(const Model& m, const T* params, const T* v, const T* a, Workspace<T>& w) {
  const V6<T> base = stack<T>(V3<T>::Zero(), -m.gravity.in(params).acceleration);
  for (std::size_t i = 0, bodies = m.bodies.size(); i < bodies; ++i) {
    const Body& body = m.bodies[i];
    if (body.is_free) {
      free_body_velocity<store_before, T>(m, i, v, w);
      continue;
    }
    V6<T> twist = body.parent == world ? V6<T>(V6<T>::Zero()) : w.twist[body.parent];
    V6<T> acceleration = body.parent == world ? base : w.acceleration[body.parent];
    for (int j = body.joint_begin; j < body.joint_end; ++j) {
      const Joint& joint = m.joints[j];
      for (int k = joint.v; k < joint.v + joint.dofs;) {
        if (m.translation_only[k]) {
          for (int axis = 3; axis < 6; ++axis) {
            twist[axis] += w.axis.row(axis)[k] * v[k];
            acceleration[axis] += w.axis.row(axis)[k] * a[k];
          }
          ++k;
          continue;
        }
        const int end = m.group_end[k];
        add_group_velocity<store_before, T>(k, end, v, a, twist, acceleration, w);
        k = end;
      }
    }
    w.twist[i] = twist;
    w.acceleration[i] = acceleration;
  }
}

// Positions and velocities of the state (q, v), with zero accelerations. `q_rounding`: see StateView, or null.
template <bool store_before, class T>
void forward_state(const Model& m, const T* params, const T* q, const T* q_rounding, const T* v, Workspace<T>& w) {
  w.generalized_acceleration.setZero();
  for (int i = 0; i < m.nq; ++i) w.q[i] = position_with_rounding(q, q_rounding, i);
  forward_positions<T>(m, params, w.q.data(), w);
  forward_velocities<store_before, T>(m, params, v, w.generalized_acceleration.data(), w);
}

// q_t = q_{t-1} ⊕ increment. `q_rounding` is that of q_{t-1} (StateView), or null.
template <class T>
void integrate(const Model& m, const T* q0, const T* q_rounding, const VX<T>& increment, PositionScalar<T>* q1) {
  using Scalar = PositionScalar<T>;
  for (const Joint& joint : m.joints) {
    for (int i = joint.q, k = joint.v; i < joint.quaternion_q(); ++i, ++k)
      q1[i] = position_with_rounding(q0, q_rounding, i) + Scalar(increment[k]);
    if (!joint.has_quaternion()) continue;
    const int i = joint.quaternion_q();
    const V4<Scalar> before(position_with_rounding(q0, q_rounding, i), position_with_rounding(q0, q_rounding, i + 1),
                            position_with_rounding(q0, q_rounding, i + 2),
                            position_with_rounding(q0, q_rounding, i + 3));
    const V3<T> turn = vec3(increment.data() + joint.angular_v());
    V4<Scalar> turned = quaternion_product<Scalar>(before, quaternion_exp<Scalar>(as<Scalar>(turn)));
    using std::sqrt;
    turned /= sqrt(turned.squaredNorm());
    for (int a = 0; a < 4; ++a) q1[i + a] = turned[a];
  }
}

// columns ← columns · ∂q_t/∂increment, where the columns refer to the tangent of q_t: Jr(φ) on rotational dofs.
template <class T>
void times_dposition_dincrement(const Model& m, const VX<T>& increment, const IslandLayout& layout,
                                IslandMatrix<T>& columns) {
  for (const Joint& joint : m.joints) {
    if (!joint.has_quaternion()) continue;
    const int k = joint.angular_v();
    const M3<T> turn = right_jacobian<T>(vec3(increment.data() + k)).transpose();
    const Island& island = layout.island_of(k);
    T* entry = columns.data() + island.begin + layout.column()[k];
    for (int row = 0; row < island.size; ++row, entry += island.stride) {
      const V3<T> turned = turn * vec3<T>(entry);
      for (int a = 0; a < 3; ++a) entry[a] = turned[a];
    }
  }
}

// (∂q_t/∂increment)ᵀ λ and (∂q_t/∂q_{t-1})ᵀ λ on tangent vectors.
template <class T>
VX<T> dposition_dincrement_vjp(const Model& m, const VX<T>& increment, VX<T> lambda) {
  for (const Joint& joint : m.joints) {
    if (!joint.has_quaternion()) continue;
    const int k = joint.angular_v();
    const V3<T> part = lambda.template segment<3>(k);
    lambda.template segment<3>(k) = right_jacobian<T>(vec3(increment.data() + k)).transpose() * part;
  }
  return lambda;
}
template <class T>
VX<T> dposition_dposition_vjp(const Model& m, const VX<T>& increment, VX<T> lambda) {
  for (const Joint& joint : m.joints) {
    if (!joint.has_quaternion()) continue;
    const int k = joint.angular_v();
    const V3<T> part = lambda.template segment<3>(k);
    lambda.template segment<3>(k) = rotation_of<T>(quaternion_exp<T>(vec3(increment.data() + k))) * part;
  }
  return lambda;
}

// Gradients with respect to q: from quaternion components to the tangent (right perturbation), and back. Quaternions may
// have any length: the kinematics normalize them.
template <class T>
VX<T> to_tangent(const Model& m, const T* q, const T* gradient) {
  VX<T> result(m.nv);
  for (const Joint& joint : m.joints) {
    for (int a = 0; a < joint.scalar_dofs(); ++a) result[joint.v + a] = gradient[joint.q + a];
    if (!joint.has_quaternion()) continue;
    const V4<T> turn = vec4(q + joint.quaternion_q());
    for (int a = 0; a < 3; ++a) {
      V4<T> unit = V4<T>::Zero();
      unit[1 + a] = T(0.5);
      const V4<T> column = quaternion_product<T>(turn, unit);
      T sum = T(0);
      for (int i = 0; i < 4; ++i) sum += column[i] * gradient[joint.quaternion_q() + i];
      result[joint.angular_v() + a] = sum;
    }
  }
  return result;
}
template <class T>
void add_from_tangent(const Model& m, const T* q, const VX<T>& tangent, T* gradient) {
  for (const Joint& joint : m.joints) {
    for (int a = 0; a < joint.scalar_dofs(); ++a) gradient[joint.q + a] += tangent[joint.v + a];
    if (!joint.has_quaternion()) continue;
    const int k = joint.angular_v();
    const V4<T> turning(T(0), tangent[k], tangent[k + 1], tangent[k + 2]);
    const V4<T> quaternion = vec4(q + joint.quaternion_q());
    const V4<T> mapped = quaternion_product<T>(quaternion, turning) * (T(2) / quaternion.squaredNorm());
    for (int i = 0; i < 4; ++i) gradient[joint.quaternion_q() + i] += mapped[i];
  }
}

}  // namespace gelflow
