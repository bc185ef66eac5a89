// Where every body is and how it moves; and the group operations q ⊕ h v of the configuration space.
//
// Joints act in order on the body's frame, as in MuJoCo. A free joint is three slides along the world's axes followed
// by a ball: velocities are (linear in the world frame, angular in the body frame). A ball's velocity is angular, in the
// frame that it turns. With S_k the motion that dof k makes possible (world frame, at the world's origin), a displacement
// of dof j carries everything behind it along:
//     ∂S_k/∂q_j = S_j × S_k   for every k behind j or in j's group (`Model::carries`),
// which is the only derivative of kinematics that the rest of the core needs.
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

// A position and what it lacks. That is ignored where it is no rounding error of this position: another was written
// since.
template <class T>
PositionScalar<T> position_with_rounding(const T* q, const T* q_rounding, int i) {
  if (std::is_same_v<T, PositionScalar<T>> || q_rounding == nullptr) return PositionScalar<T>(q[i]);
  const PositionScalar<T> sum = PositionScalar<T>(q[i]) + PositionScalar<T>(q_rounding[i]);
  return T(sum) == q[i] ? sum : PositionScalar<T>(q[i]);
}

template <class T>
void forward_positions(const Model& m, const T* params, const PositionScalar<T>* q, Workspace<T>& w) {
  using Scalar = PositionScalar<T>;
  const auto set_axis = [&](int k, const V3<Scalar>& moment, const V3<Scalar>& direction) {
    w.axis.set(k, as<T>(stack<Scalar>(moment, direction)));
  };
  for (std::size_t i = 0; i < m.bodies.size(); ++i) {
    const Body& body = m.bodies[i];
    const bool root = body.parent == world;
    M3<Scalar> r = body.rotation.template cast<Scalar>();
    V3<Scalar> p = as<Scalar>(vec3(params + body.pos));
    if (!root) {
      p = (w.position[body.parent] + w.rotation[body.parent] * p).eval();
      r = (w.rotation[body.parent] * r).eval();
    }
    for (int j = body.joint_begin; j < body.joint_end; ++j) {
      const Joint& joint = m.joints[j];
      const Scalar* value = q + joint.q;
      if (joint.type == JointType::free) {
        p = vec3(value);
        r = rotation_of<Scalar>(V4<Scalar>(value[3], value[4], value[5], value[6]));
        for (int a = 0; a < 3; ++a) {
          set_axis(joint.v + a, V3<Scalar>::Zero(), V3<Scalar>::Unit(a));
          const V3<Scalar> turn = r.col(a);
          set_axis(joint.v + 3 + a, turn, cross<Scalar>(p, turn));
        }
        continue;
      }
      if (joint.type == JointType::ball) {
        const V3<Scalar> offset = joint.pos.template cast<Scalar>();
        const V3<Scalar> anchor = p + r * offset;
        r = (r * rotation_of<Scalar>(V4<Scalar>(value[0], value[1], value[2], value[3]))).eval();
        p = anchor - r * offset;
        for (int a = 0; a < 3; ++a) {
          const V3<Scalar> turn = r.col(a);
          set_axis(joint.v + a, turn, cross<Scalar>(anchor, turn));
        }
        continue;
      }
      const V3<Scalar> local = joint.axis.template cast<Scalar>();
      const V3<Scalar> direction = r * local;
      if (joint.type == JointType::slide) {
        set_axis(joint.v, V3<Scalar>::Zero(), direction);
        p += direction * (value[0] - Scalar(joint.ref));
      } else {
        const V3<Scalar> offset = joint.pos.template cast<Scalar>();
        const V3<Scalar> anchor = p + r * offset;
        set_axis(joint.v, direction, cross<Scalar>(anchor, direction));
        r = (r * axis_rotation<Scalar>(local, value[0] - Scalar(joint.ref))).eval();
        p = anchor - r * offset;
      }
    }
    w.rotation[i] = r;
    w.position[i] = p;
  }
}

// Twists V and accelerations A of every body; gravity enters as an acceleration of the world. `around`: also what is
// before and after each dof, which derivatives need. What is before slides that nothing turns is not written down: only
// its turning would count, and there is none. Bodies that float have no accelerations here (inverse_dynamics.hpp).
template <bool around, class T>
void forward_velocities(const Model& m, const T* params, const T* v, const T* a, Workspace<T>& w) {
  const V6<T> base = stack<T>(V3<T>::Zero(), -vec3(params + m.gravity));
  for (std::size_t i = 0; i < m.bodies.size(); ++i) {
    const Body& body = m.bodies[i];
    if (body.is_free) {
      const int k = m.joints[body.joint_begin].v;
      const V3<T> slide = vec3(v + k), turn = as<T>(w.rotation[i]) * vec3(v + k + 3);
      w.twist[i] = stack<T>(turn, slide + cross<T>(as<T>(w.position[i]), turn));
      if constexpr (around) {
        const V6<T> before = stack<T>(V3<T>::Zero(), slide);
        for (int g = k + 3; g < k + 6; ++g) w.twist_before.set(g, before);
      }
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
        const V6<T> before = twist;
        V6<T> own = V6<T>::Zero(), own_rate = own;
        for (int g = k; g < end; ++g) {
          const V6<T> axis = w.axis[g];
          own += axis * v[g];
          own_rate += axis * a[g];
        }
        twist += own;
        if constexpr (around) {
          for (int g = k; g < end; ++g) {
            w.twist_before.set(g, before);
            w.twist_after[g] = twist;
            w.acceleration_before[g] = acceleration;
          }
        }
        acceleration += own_rate + cross_motion<T>(before, own);
        k = end;
      }
    }
    w.twist[i] = twist;
    w.acceleration[i] = acceleration;
  }
}

// Both of a state (q, v) with accelerations zero; `low`: what q lacks, or null.
template <bool around, class T>
void forward_state(const Model& m, const T* params, const T* q, const T* q_rounding, const T* v, Workspace<T>& w) {
  w.update.setZero();
  for (int i = 0; i < m.nq; ++i) w.q[i] = position_with_rounding(q, q_rounding, i);
  forward_positions<T>(m, params, w.q.data(), w);
  forward_velocities<around, T>(m, params, v, w.update.data(), w);
}

// q_t = q_{t-1} ⊕ increment; `low`: what q_{t-1} lacks, or null.
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

// columns ← columns · ∂q_t/∂increment, where the columns belong to the tangent of q_t: Jr(φ) on turning dofs.
template <class T>
void times_position_by_increment(const Model& m, const VX<T>& increment, typename Workspace<T>::Rows& columns) {
  for (const Joint& joint : m.joints) {
    if (!joint.has_quaternion()) continue;
    const int k = joint.angular_v();
    const M3<T> turn = right_jacobian<T>(vec3(increment.data() + k)).transpose();
    for (Eigen::Index row = 0; row < columns.rows(); ++row) {
      const V3<T> old = vec3(&columns(row, k)), turned = turn * old;
      for (int a = 0; a < 3; ++a) columns(row, k + a) = turned[a];
    }
  }
}

// (∂q_t/∂increment)ᵀ λ and (∂q_t/∂q_{t-1})ᵀ λ on tangent vectors.
template <class T>
VX<T> position_by_increment_vjp(const Model& m, const VX<T>& increment, VX<T> lambda) {
  for (const Joint& joint : m.joints) {
    if (!joint.has_quaternion()) continue;
    const int k = joint.angular_v();
    const V3<T> part = lambda.template segment<3>(k);
    lambda.template segment<3>(k) = right_jacobian<T>(vec3(increment.data() + k)).transpose() * part;
  }
  return lambda;
}
template <class T>
VX<T> position_by_position_vjp(const Model& m, const VX<T>& increment, VX<T> lambda) {
  for (const Joint& joint : m.joints) {
    if (!joint.has_quaternion()) continue;
    const int k = joint.angular_v();
    const V3<T> part = lambda.template segment<3>(k);
    lambda.template segment<3>(k) = rotation_of<T>(quaternion_exp<T>(vec3(increment.data() + k))) * part;
  }
  return lambda;
}

// Gradients of a unit quaternion: from the four numbers to the tangent (right perturbation) and back.
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
    const V4<T> mapped = quaternion_product<T>(vec4(q + joint.quaternion_q()), turning) * T(2);
    for (int i = 0; i < 4; ++i) gradient[joint.quaternion_q() + i] += mapped[i];
  }
}

}  // namespace gelflow
