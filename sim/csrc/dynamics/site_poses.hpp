// Poses of sites, named frames on bodies, at given positions q, and their vector-Jacobian product. One compiled version in
// double precision.
#pragma once

#include <string>
#include <vector>

#include "model/definitions.hpp"
#include "model/model.hpp"

namespace gelflow {

struct SiteDef {
  std::string name;
  int body = world;
  PoseDef pose;  // in the body frame
};

// Positions q (rows, nq) of N environments, one after the other: row i has the parameters of environment i % N.
struct SiteRows {
  const double* q;
  const double* params;  // (N, parameters)
  int rows, environments;
};

// `poses` (rows, sites, 7): position, quaternion.
void site_poses(const Model& m, const std::vector<SiteDef>& sites, const SiteRows& at, double* poses);

// Adds to grad_q (rows, nq) the gradient of a scalar with gradient `grad_poses` (rows, sites, 7); for quaternions of q
// the tangent gradient.
void site_poses_vjp(const Model& m, const std::vector<SiteDef>& sites, const SiteRows& at, const double* grad_poses,
                    double* grad_q);

}  // namespace gelflow
