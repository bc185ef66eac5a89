// The immutable model: the elements of a scene and its kinematic tree. Numbers that randomization, calibration and
// gradients change are physical parameters, one flat array per environment (parameters.hpp); the model has their offsets
// and names.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "geometry/distance_grid.hpp"
#include "geometry/point_cloud.hpp"
#include "model/parameter_checks.hpp"
#include "model/parameters.hpp"

namespace gelflow {

enum class JointType : std::uint8_t { slide, hinge, ball, free };
enum class ShapeKind : std::uint8_t {
  plane,
  sphere,
  box,
  cylinder,
  capsule,
  ellipsoid,
  rounded_box,
  rounded_cylinder,
  grid
};
enum class FrictionLaw : std::uint8_t { viscous, elastic };
enum class DampingLaw : std::uint8_t { hunt_crossley, linear };  // contact_law.hpp
enum class ActuatorKind : std::uint8_t { motor, position, velocity, general };

struct Body {
  std::string name;
  int parent;           // moving body, or world
  V4<double> quat;      // of the body frame in the parent's frame at q = 0
  M3<double> rotation;  // the same as a matrix
  int joint_begin, joint_end;
  ParamBlock<BodyParams> params;
  ParamBlock<GravityCompensationParams> compensation;  // of bodies in Model::compensated_bodies
  std::vector<int> dofs;                               // all dofs that move this body, root first
  bool translation_only = false;                       // all of them are slides
  bool is_free = false;                                // it has a free joint and no child
};

struct Joint {
  std::string name;
  JointType type;
  int body;
  V3<double> pos, axis;  // in the body frame
  int q, v;              // first position and first velocity
  int dofs;              // 1, 3 (ball) or 6 (free)
  double ref;            // position of a slide or hinge at which the body has the pose of its definition
  ParamBlock<JointParams> params;

  // The positions of a joint are `scalar_dofs` numbers, then the unit quaternion of a ball or free joint.
  bool has_quaternion() const { return type == JointType::ball || type == JointType::free; }
  int scalar_dofs() const { return type == JointType::free ? 3 : type == JointType::ball ? 0 : 1; }
  int quaternion_q() const { return q + scalar_dofs(); }
  int angular_v() const { return v + scalar_dofs(); }
};

struct Shape {
  std::string name;
  ShapeKind kind;
  int body;
  M3<double> rotation;          // in the body frame, before the rotation of `pose`
  ParamBlock<SizeParams> size;  // followed by RoundingParams where the shape is rounded
  ParamBlock<PoseParams> pose;
  std::shared_ptr<const DistanceGrid> grid;  // of a shape of kind grid
};

// The frame of a point set or a pad in its body frame. Where the parameters differ from it, the points follow them
// (pair_frame.hpp).
struct Mount {
  int body;
  V3<double> pos;
  M3<double> rotation;
  ParamBlock<PoseParams> pose;
  ParamBlock<ScaleParams> scale;  // of point sets; pads have none

  bool has_scale() const { return scale.offset >= 0; }
};

struct PointSet {
  std::string name;
  Mount mount;
  double radius;  // > 0: one point, the centre of a sphere whose lowest point touches planes
  PointCloud cloud;
};

// The dofs that move one body of a pair and not the other: only these change the relative motion. They are the columns
// of the contact Jacobian, in packs of neighbouring dofs, one packing for each SIMD width (simd_pack.hpp).
struct PackedDofs {
  std::vector<int> start;    // first dof of each pack
  std::vector<int> dof;      // per column; −1 where the dof moves neither body or both
  std::vector<double> sign;  // per column: +1 where the dof moves the first body, −1 the second, else 0
  // Columns × columns: 1 where ∂S_row/∂q_column counts (contact_jacobian.hpp), else 0.
  std::vector<double> axis_coupling;
  std::vector<std::uint8_t> linear;        // per column: it is a translation
  std::vector<std::uint8_t> has_coupling;  // per column: its row of `axis_coupling` has a 1
};
struct PairDofs {
  PackedDofs single, four, eight;

  template <int width>
  const PackedDofs& packed() const {
    return width == 8 ? eight : width == 4 ? four : single;
  }
};

struct Contact {
  std::string name;
  int points, shape;
  FrictionLaw law;
  DampingLaw damping;
  ParamBlock<ContactParams> params;
  int anchor;  // first anchor slot, −1 under the viscous law
  PairDofs pair;
  int first_tree = -1, second_tree = -1;  // the trees that it joins; −1 if it joins none (solver/islands.hpp)
  bool uses_arc_correction = false;       // a free body on a plane of the world (arc_correction.hpp)
};

struct Pad {
  std::string name;
  Mount mount;
  PointCloud cloud;
  std::vector<M3<double>> frames;  // sorted like the cloud; columns x, y, z
  bool flat;                       // all frames are equal
  std::vector<int> shapes;
  FrictionLaw law;
  ParamBlock<ContactParams> params;
  int anchor;        // first anchor slot; shape s, marker i is at anchor + s * markers + i
  int first_marker;  // in the tactile output
  bool collides;     // the markers are contact points: one contact per shape shares its parameters and anchors
  std::vector<PairDofs> pairs;  // one per shape
};

// A fixed tendon: its length is the sum of coefficient × position over slides and hinges.
struct Tendon {
  struct Term {
    int q, dof;
    double coefficient;
  };
  std::string name;
  std::vector<Term> terms;
  ParamBlock<JointParams> params;  // of its length
};

// A slide or hinge whose position is offset + ratio × that of a leader, or fixed. It is no unknown of a step
// (couplings.hpp).
struct Coupling {
  std::string name;
  int q, dof;
  int leader_q, leader_dof;  // −1: the position is fixed, and the ratio 0
  double ratio, offset;
};

// A slide or hinge whose position is a polynomial of that of a leader (polynomial_couplings.hpp).
struct PolynomialCoupling {
  std::string name;
  int q, dof;
  int leader_q, leader_dof;
  std::vector<double> coefficients;  // of the powers 0, 1, …
  ParamBlock<SpringParams> params;
};

// Two points that coincide, and of a weld the orientations of their bodies (loop_closures.hpp).
struct LoopClosure {
  std::string name;
  int first, second;  // bodies
  bool weld;
  M3<double> rotation;  // of a weld: the first body in the frame of the second
  ParamBlock<LoopClosureParams> params;
  PairDofs pair;
};

// Consecutive dofs, end excluded.
struct DofRange {
  int begin, end;
};

struct Actuator {
  std::string name;
  ActuatorKind kind;
  int dof, q;  // of the joint that it drives
  int tendon;  // that it drives instead, or −1
  ParamBlock<ActuatorParams> params;
};

// Larger ones accept steps that ignore the acting forces.
constexpr double largest_tolerance = 0.1;

// Settings of the integrator and of Newton's method.
struct SolverOptions {
  double step = 5e-3;       // h [s]
  double tolerance = 1e-7;  // of Newton's method: residual relative to the acting forces
  int max_iterations = 50;
  int max_step_iterations = 1000;  // in all attempts and substeps of one step
  int max_halvings = 6;
  int polish = 0;  // Newton iterations after convergence
};

struct Model : SolverOptions {
  std::vector<Body> bodies;
  std::vector<Joint> joints;
  std::vector<Shape> shapes;
  std::vector<PointSet> point_sets;
  std::vector<Contact> contacts;
  std::vector<Pad> pads;
  std::vector<Tendon> tendons;
  std::vector<Coupling> couplings;   // whose leaders follow no other joint
  std::vector<int> prescribed_dofs;  // whose velocity no force changes
  std::vector<int> compensated_bodies;
  std::vector<PolynomialCoupling> polynomial_couplings;
  std::vector<LoopClosure> loop_closures;
  std::vector<Actuator> actuators;

  std::vector<std::string> param_names;
  std::vector<double> param_defaults;
  std::vector<ParamSign> param_signs;
  ParamBlock<GravityParams> gravity;

  int nq = 0, nv = 0, na = 0, num_markers = 0;  // positions, velocities, anchors, markers
  int nh = 0;                                   // numbers in the history of BDF2, 2 nv + 1 (step.hpp); 0 under BDF1
  int jacobian_columns = 0;                     // the most columns of a pair (PackedDofs)
  std::vector<double> q0;                       // reference positions

  // Per dof: its body, its joint; its group, the three rotational dofs of a ball or free joint, else itself; whether it
  // is a rotation; whether it and all its ancestors are translations.
  std::vector<int> dof_body, dof_joint;
  std::vector<int> group_begin, group_end;
  std::vector<std::uint8_t> angular, translation_only;
  std::vector<int> articulated_dofs;  // dofs of bodies that are not free
  // Moving dof j moves the axis of dof k: j is an ancestor of k, or in its group.
  bool is_ancestor(int j, int k) const {
    const std::vector<int>& dofs = bodies[dof_body[k]].dofs;
    return (j <= k || group_begin[j] == group_begin[k]) && std::binary_search(dofs.begin(), dofs.end(), j);
  }

  // The kinematic trees; trees whose dofs alternate count as one.
  std::vector<DofRange> trees;
  std::vector<int> dof_tree;                       // per dof
  std::vector<std::pair<int, int>> coupled_trees;  // always in one island: by couplings, tendons and loop closures
  bool has_islands = false;                        // the dofs may form several systems (solver/islands.hpp)
};

}  // namespace gelflow
