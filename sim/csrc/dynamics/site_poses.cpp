#include "dynamics/site_poses.hpp"

#include <algorithm>

#include "dynamics/kinematics.hpp"

namespace gelflow {

namespace {

struct SitePose {
  V3<double> position;
  V4<double> quaternion;
};

SitePose site_pose(const SiteDef& site, const Workspace<double>& w) {
  M3<double> rotation = rotation_of<double>(site.pose.quat);
  V3<double> position = site.pose.pos;
  if (site.body != world) {
    position = (w.position[site.body] + w.rotation[site.body] * position).eval();
    rotation = (w.rotation[site.body] * rotation).eval();
  }
  const Eigen::Quaternion<double> turn(rotation);
  return {position, {turn.w(), turn.x(), turn.y(), turn.z()}};
}

// Computes the kinematics of each row and calls visit(q of the row, row).
template <class Visit>
void for_rows(const Model& m, const SiteRows& at, Workspace<double>& w, Visit&& visit) {
  for (int row = 0; row < at.rows; ++row) {
    const double* const q = at.q + static_cast<std::ptrdiff_t>(row) * m.nq;
    const std::size_t environment = row % at.environments;
    forward_positions<double>(m, at.params + environment * m.param_names.size(), q, w);
    visit(q, row);
  }
}

}  // namespace

void site_poses(const Model& m, const std::vector<SiteDef>& sites, const SiteRows& at, double* poses) {
  Workspace<double> w(m);
  for_rows(m, at, w, [&](const double*, int) {
    for (const SiteDef& site : sites) {
      const SitePose pose = site_pose(site, w);
      poses = std::copy_n(pose.position.data(), 3, poses);
      poses = std::copy_n(pose.quaternion.data(), 4, poses);
    }
  });
}

// A motion (ω, v) of the body, v at the world's origin, moves the site by v + ω × x and changes its quaternion Q by
// ½ (0, ω) ⊗ Q. A gradient F by the position therefore acts like a force at x.
void site_poses_vjp(const Model& m, const std::vector<SiteDef>& sites, const SiteRows& at, const double* grad_poses,
                    double* grad_q) {
  Workspace<double> w(m);
  for_rows(m, at, w, [&](const double* q, int row) {
    VX<double> grad_tangent = VX<double>::Zero(m.nv);
    for (const SiteDef& site : sites) {
      const V3<double> grad_position = vec3(grad_poses);
      const V4<double> grad_quaternion = vec4(grad_poses + 3);
      grad_poses += 7;
      if (site.body == world) continue;
      const SitePose pose = site_pose(site, w);
      V3<double> grad_rotation = pose.position.cross(grad_position);
      for (int a = 0; a < 3; ++a) {
        V4<double> half_axis = V4<double>::Zero();
        half_axis[1 + a] = 0.5;
        grad_rotation[a] += quaternion_product<double>(half_axis, pose.quaternion).dot(grad_quaternion);
      }
      for (const int k : m.bodies[site.body].dofs) {
        grad_tangent[k] += w.axis[k].head<3>().dot(grad_rotation) + w.axis[k].tail<3>().dot(grad_position);
      }
    }
    add_from_tangent<double>(m, q, grad_tangent, grad_q + static_cast<std::ptrdiff_t>(row) * m.nq);
  });
}

}  // namespace gelflow
