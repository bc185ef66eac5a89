// Where every body is and how it moves; and the group operations q ⊕ h v of the configuration space.
//
// Joints act in order on the body's frame, as in MuJoCo. A free joint is three slides along the world's axes followed
// by a ball: velocities are (linear in the world frame, angular in the body frame). With S_k the motion that dof k
// makes possible (world frame, at the world's origin), a displacement of dof j carries everything behind it along:
//     ∂S_k/∂q_j = S_j × S_k   for every k behind j or in j's group (`Model::carries`),
// which is the only derivative of kinematics that the rest of the core needs.
#pragma once

#include "workspace.hpp"

namespace gelflow {

template <class T>
V3<T> vec3(const T* p) {
  return {p[0], p[1], p[2]};
}

template <class T>
void forward_positions(const Model& m, const T* params, const T* q, Workspace<T>& w) {
  for (std::size_t i = 0; i < m.bodies.size(); ++i) {
    const Body& body = m.bodies[i];
    const bool root = body.parent == world;
    M3<T> r = rotation_of<T>(body.quat.template cast<T>());
    V3<T> p = vec3(params + body.pos);
    if (!root) {
      p = (w.position[body.parent] + w.rotation[body.parent] * p).eval();
      r = (w.rotation[body.parent] * r).eval();
    }
    for (int j = body.joint_begin; j < body.joint_end; ++j) {
      const Joint& joint = m.joints[j];
      const T* value = q + joint.q;
      if (joint.type == JointType::free) {
        p = vec3(value);
        r = rotation_of<T>(V4<T>(value[3], value[4], value[5], value[6]));
        for (int a = 0; a < 3; ++a) {
          w.axis[joint.v + a] = stack<T>(V3<T>::Zero(), V3<T>::Unit(a));
          const V3<T> turn = r.col(a);
          w.axis[joint.v + 3 + a] = stack<T>(turn, cross<T>(p, turn));
        }
        continue;
      }
      const V3<T> local = joint.axis.template cast<T>();
      const V3<T> direction = r * local;
      if (joint.type == JointType::slide) {
        w.axis[joint.v] = stack<T>(V3<T>::Zero(), direction);
        p += direction * value[0];
      } else {
        const V3<T> offset = joint.pos.template cast<T>();
        const V3<T> anchor = p + r * offset;
        w.axis[joint.v] = stack<T>(direction, cross<T>(anchor, direction));
        r = (r * axis_rotation<T>(local, value[0])).eval();
        p = anchor - r * offset;
      }
    }
    w.rotation[i] = r;
    w.position[i] = p;
  }
}

// Twists V and accelerations A of every body; gravity enters as an acceleration of the world.
template <class T>
void forward_velocities(const Model& m, const T* params, const T* v, const T* a, Workspace<T>& w) {
  const V6<T> base = stack<T>(V3<T>::Zero(), -vec3(params + m.gravity));
  for (std::size_t i = 0; i < m.bodies.size(); ++i) {
    const Body& body = m.bodies[i];
    V6<T> twist = body.parent == world ? V6<T>(V6<T>::Zero()) : w.twist[body.parent];
    V6<T> acceleration = body.parent == world ? base : w.acceleration[body.parent];
    for (int j = body.joint_begin; j < body.joint_end; ++j) {
      const Joint& joint = m.joints[j];
      for (int k = joint.v; k < joint.v + joint.dofs;) {
        const int end = m.group_end[k];
        const V6<T> before = twist, acceleration_before = acceleration;
        for (int g = k; g < end; ++g) {
          twist += w.axis[g] * v[g];
          acceleration += w.axis[g] * a[g] + cross_motion<T>(before, w.axis[g]) * v[g];
        }
        for (int g = k; g < end; ++g) {
          w.twist_before[g] = before;
          w.twist_after[g] = twist;
          w.acceleration_before[g] = acceleration_before;
        }
        k = end;
      }
    }
    w.twist[i] = twist;
    w.acceleration[i] = acceleration;
  }
}

// q_t = q_{t-1} ⊕ h v.
template <class T>
void integrate(const Model& m, const T* q0, const T* v, const T& h, T* q1) {
  for (const Joint& joint : m.joints) {
    if (joint.type != JointType::free) {
      q1[joint.q] = q0[joint.q] + h * v[joint.v];
      continue;
    }
    for (int a = 0; a < 3; ++a) q1[joint.q + a] = q0[joint.q + a] + h * v[joint.v + a];
    const V4<T> turn(q0[joint.q + 3], q0[joint.q + 4], q0[joint.q + 5], q0[joint.q + 6]);
    V4<T> turned = quaternion_product<T>(turn, quaternion_exp<T>(vec3(v + joint.v + 3) * h));
    using std::sqrt;
    turned /= sqrt(turned.squaredNorm());
    for (int a = 0; a < 4; ++a) q1[joint.q + 3 + a] = turned[a];
  }
}

// columns ← columns · ∂q_t/∂v_t, where the columns belong to the tangent of q_t: h, and h Jr(h ω) on turning dofs.
template <class T>
void times_position_by_velocity(const Model& m, const T* v, const T& h, MX<T>& columns) {
  columns *= h;
  for (const Joint& joint : m.joints) {
    if (joint.type != JointType::free) continue;
    const auto turning = columns.middleCols(joint.v + 3, 3);
    columns.middleCols(joint.v + 3, 3) = (turning * right_jacobian<T>(vec3(v + joint.v + 3) * h)).eval();
  }
}

// (∂q_t/∂v_t)ᵀ λ and (∂q_t/∂q_{t-1})ᵀ λ on tangent vectors.
template <class T>
VX<T> position_by_velocity_transposed(const Model& m, const T* v, const T& h, const VX<T>& lambda) {
  VX<T> result = lambda * h;
  for (const Joint& joint : m.joints) {
    if (joint.type != JointType::free) continue;
    const V3<T> phi = vec3(v + joint.v + 3) * h;
    result.segment(joint.v + 3, 3) = right_jacobian<T>(phi).transpose() * lambda.segment(joint.v + 3, 3) * h;
  }
  return result;
}
template <class T>
VX<T> position_by_position_transposed(const Model& m, const T* v, const T& h, const VX<T>& lambda) {
  VX<T> result = lambda;
  for (const Joint& joint : m.joints) {
    if (joint.type != JointType::free) continue;
    const V4<T> turn = quaternion_exp<T>(vec3(v + joint.v + 3) * h);
    result.segment(joint.v + 3, 3) = rotation_of<T>(turn) * lambda.segment(joint.v + 3, 3);
  }
  return result;
}

// Gradients of a unit quaternion: from the four numbers to the tangent (right perturbation) and back.
template <class T>
VX<T> to_tangent(const Model& m, const T* q, const T* gradient) {
  VX<T> result(m.nv);
  for (const Joint& joint : m.joints) {
    if (joint.type != JointType::free) {
      result[joint.v] = gradient[joint.q];
      continue;
    }
    for (int a = 0; a < 3; ++a) result[joint.v + a] = gradient[joint.q + a];
    const V4<T> turn(q[joint.q + 3], q[joint.q + 4], q[joint.q + 5], q[joint.q + 6]);
    for (int a = 0; a < 3; ++a) {
      V4<T> unit = V4<T>::Zero();
      unit[1 + a] = T(0.5);
      const V4<T> column = quaternion_product<T>(turn, unit);
      T sum = T(0);
      for (int i = 0; i < 4; ++i) sum += column[i] * gradient[joint.q + 3 + i];
      result[joint.v + 3 + a] = sum;
    }
  }
  return result;
}
template <class T>
void add_from_tangent(const Model& m, const T* q, const VX<T>& tangent, T* gradient) {
  for (const Joint& joint : m.joints) {
    if (joint.type != JointType::free) {
      gradient[joint.q] += tangent[joint.v];
      continue;
    }
    for (int a = 0; a < 3; ++a) gradient[joint.q + a] += tangent[joint.v + a];
    const V4<T> turn(q[joint.q + 3], q[joint.q + 4], q[joint.q + 5], q[joint.q + 6]);
    const V4<T> turning(T(0), tangent[joint.v + 3], tangent[joint.v + 4], tangent[joint.v + 5]);
    const V4<T> mapped = quaternion_product<T>(turn, turning) * T(2);
    for (int i = 0; i < 4; ++i) gradient[joint.q + 3 + i] += mapped[i];
  }
}

}  // namespace gelflow
