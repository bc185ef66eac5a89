// Definitions of the elements of a scene, as ModelSpec takes them. SI units; quaternions are w x y z; an index of a body
// is that of a moving body, or `world`.
#pragma once

#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "geometry/distance_grid.hpp"
#include "model/parameters.hpp"

namespace gelflow {

constexpr double unlimited = std::numeric_limits<double>::infinity();

// A frame relative to another one.
struct PoseDef {
  V3<double> pos = V3<double>::Zero();    // [m]
  V4<double> quat = V4<double>::Unit(0);  // unit quaternion
};

struct BodyDef {
  std::string name;
  int parent = world;
  PoseDef pose;                             // in the parent's frame at q = 0
  double mass = 0;                          // [kg]
  V3<double> com = V3<double>::Zero();      // centre of mass in the body frame [m]
  V6<double> inertia = V6<double>::Zero();  // about the centre of mass: xx, yy, zz, xy, xz, yz [kg m²]
  GravityCompensationParams<double> compensation{0, V3<double>::Zero()};
};

struct JointDef {
  std::string name;
  int body = 0;
  std::string type;                       // slide, hinge, ball or free
  V3<double> pos = V3<double>::Zero();    // in the body frame [m]
  V3<double> axis = V3<double>::Unit(2);  // of a slide or hinge, in the body frame; need not have length 1
  JointParams<double> params{0, 0, 0, 0, -unlimited, unlimited, 0, 0, 0};
  double ref = 0;           // position at which the body has the pose of its definition
  bool prescribed = false;  // no force changes its velocity
};

struct ShapeDef {
  std::string name;
  int body = world;
  std::string kind;                          // plane, sphere, box, cylinder, capsule, ellipsoid or grid
  PoseDef pose;                              // in the body frame
  V3<double> size = V3<double>::Zero();      // see SizeParams
  double rounding = 0;                       // radius of the edges of a box or cylinder [m]
  std::shared_ptr<const DistanceGrid> grid;  // of a shape of kind grid
};

struct PointsDef {
  std::string name;
  int body = world;
  std::vector<V3<double>> points;                // in the set's frame [m]
  std::optional<std::vector<double>> weights;    // 1 each unless given
  double radius = 0;                             // > 0: one point, the centre of a sphere that touches planes [m]
  PoseDef pose;                                  // of the set's frame in the body frame
  std::optional<std::vector<V3<double>>> areas;  // where weights are areas: the share of each axis, see PointCloud
};

struct ContactDef {
  std::string name;
  int points = 0, shape = 0;
  std::string law = "viscous";            // friction: viscous or elastic
  std::string damping = "hunt-crossley";  // hunt-crossley (k_d scaled by depth) or linear
  ContactParams<double> params{0, 0, 0, 0, 0};
};

struct PadDef {
  std::string name;
  int body = world;
  std::vector<V3<double>> positions;  // of the markers, in the pad's frame [m]
  std::optional<std::vector<M3<double>>>
      axes;                 // of the markers: columns x, y, z; those of the pad's frame unless given
  std::vector<int> shapes;  // that the pad touches
  std::string law = "viscous";
  ContactParams<double> params{0, 0, 0, 0, 0};
  std::optional<std::vector<double>> weights;  // 1 each unless given
  PoseDef pose;                                // of the pad's frame in the body frame
  bool collides = false;                       // the markers are contact points too
};

// A fixed tendon: its length is the sum of coefficient × position over slides and hinges.
struct TendonDef {
  std::string name;
  std::vector<int> joints;
  std::vector<double> coefficients;                                        // one per joint
  JointParams<double> params{0, 0, 0, 0, -unlimited, unlimited, 0, 0, 0};  // of its length
};

// A slide or hinge whose position is a polynomial of that of another one.
struct CouplingDef {
  std::string name;
  int joint = 0;
  int leader = -1;                    // −1: the position is fixed
  std::vector<double> coefficients;   // of the powers 0, 1, … of the leader's position
  SpringParams<double> params{0, 0};  // above degree 1, where a damped spring keeps the coupling
};

// Two points of two bodies that coincide; of a weld also the orientations of the bodies.
struct LoopClosureDef {
  std::string name;
  int first = world, second = world;  // bodies
  bool weld = false;
  V4<double> quat = V4<double>::Unit(0);  // of a weld: the first body in the frame of the second
  LoopClosureParams<double> params{0, 0, 0, 0, V3<double>::Zero(), V3<double>::Zero()};
};

struct ActuatorDef {
  std::string name;
  int joint = 0;
  int tendon = -1;   // driven instead of the joint
  std::string kind;  // motor, position, velocity or general
  ActuatorParams<double> params{1, 0, 0, -unlimited, unlimited, -unlimited, unlimited, 1, 0};
};

}  // namespace gelflow
