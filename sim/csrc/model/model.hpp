// The immutable model: what is in the scene and how it hangs together. Numbers that randomization, calibration and
// gradients change live in Params, one flat array per environment; the model holds the offsets and the names.
#pragma once

#include <array>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "geometry/distance_grid.hpp"
#include "geometry/point_cloud.hpp"

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
enum class DampingLaw : std::uint8_t { depth, plain };  // k_d scaled by depth (eq. 8), or not (ground)
enum class ActuatorKind : std::uint8_t { motor, position, velocity, general };

constexpr int world = -1;

struct Body {
  std::string name;
  int parent;           // moving body, or world
  V4<double> quat;      // of the frame in the parent's frame at q = 0;
  M3<double> rotation;  // the same
  int joint_begin, joint_end;
  int mass, pos;                  // offsets in Params: mass, com (3), inertia (6); pos (3)
  std::vector<int> dofs;          // all dofs that move this body, root first
  bool translation_only = false;  // all of them do (Model::translates)
  bool is_free = false;           // a free joint, and no body on it
};

struct Joint {
  std::string name;
  JointType type;
  int body;
  V3<double> pos, axis;  // in the body's frame
  int q, v;              // first position and first velocity
  int dofs;              // 1, 3 (ball) or 6 (free)
  double ref;            // position at which the joint does not move its body
  int param;             // damping, armature, stiffness, springref, lower, upper, limit_stiffness, limit_damping,
                         // frictionloss

  // A ball or free joint turns by a unit quaternion; before it come `plain` positions that are just numbers.
  bool has_quaternion() const { return type == JointType::ball || type == JointType::free; }
  int scalar_dofs() const { return type == JointType::free ? 3 : type == JointType::ball ? 0 : 1; }
  int quaternion_q() const { return q + scalar_dofs(); }
  int angular_v() const { return v + scalar_dofs(); }
};

struct Shape {
  std::string name;
  ShapeKind kind;
  int body;
  M3<double> rotation;  // in the body's frame, before it is turned
  int size;  // offset in Params (3): half sizes or half axes; radius, then half length along z; a grid's scale. The
             // rounding is the fourth, where there is one
  int pose_param;                            // offset in Params (6): pos, turn
  std::shared_ptr<const DistanceGrid> grid;  // of the kind grid
};

// The frame of a point set or a pad in its body, as its points were given. Params may have it elsewhere, turned and
// scaled: then the points follow (pair_frame.hpp).
struct Mount {
  int body;
  V3<double> pos;
  M3<double> rotation;
  int pose_param;  // offset in Params (6): pos, turn; (9) where it scales: scale
  bool scales;     // points do, pads do not
};

struct PointSet {
  std::string name;
  Mount mount;
  double radius;  // > 0: one point, the centre of a sphere whose lowest point touches planes
  PointCloud cloud;
};

// The dofs that move one body of a pair and not the other; they alone change the relative motion. In packs of
// neighbouring dofs, for each of the widths that numbers come in (simd_pack.hpp).
struct PackedDofs {
  std::vector<int> start;    // first dof of each pack
  std::vector<int> dof;      // per column, −1 where the column is none of the pair's
  std::vector<double> sign;  // +1 where the dof moves the first body, −1 the second, 0 none of the pair's
  std::vector<double>
      axis_coupling;  // columns × columns: 1 where ∂S_row/∂q_column counts (contact_jacobian.hpp), else 0
  std::vector<std::uint8_t> linear, has_coupling;  // per column: it never turns; as a row of `turned` it has a 1
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
  int param;   // kn, kt, mu, kd, ks
  int anchor;  // first anchor slot, −1 under the viscous law
  PairDofs pair;
  bool uses_arc_correction = false;  // a free body on a plane of the world (arc_correction.hpp)
};

struct Pad {
  std::string name;
  Mount mount;
  PointCloud cloud;
  std::vector<M3<double>> frames;  // sorted like the cloud; columns x, y, z
  bool flat;                       // they are all the same
  std::vector<int> shapes;
  FrictionLaw law;
  int param;                    // kn, kt, mu, kd, ks
  int anchor;                   // first anchor slot; shape s, marker i is at anchor + s * markers + i
  int first_marker;             // in the tactile output
  bool pushes;                  // its markers are contact points: contacts of its own have its numbers and anchors
  std::vector<PairDofs> pairs;  // one per shape
};

struct Actuator {
  std::string name;
  ActuatorKind kind;
  int dof, q;
  int param;  // gear, kp, kd, force_lower, force_upper, ctrl_lower, ctrl_upper, gain, bias
};

struct Model {
  std::vector<Body> bodies;
  std::vector<Joint> joints;
  std::vector<Shape> shapes;
  std::vector<PointSet> point_sets;
  std::vector<Contact> contacts;
  std::vector<Pad> pads;
  std::vector<Actuator> actuators;

  std::vector<std::string> param_names;
  std::vector<double> param_defaults;
  int gravity = 0;  // offset in Params (3)

  int nq = 0, nv = 0, na = 0, markers = 0;  // positions, velocities, anchors, markers
  int nh = 0;                               // BDF2's history: 2 nv + 1 numbers, see step.hpp; BDF1 has none
  int jacobian_columns = 0;                 // the most that a pair has, see PackedDofs
  std::vector<double> q0;                   // reference positions

  // Per dof: its body, its group (dofs of one ball turn together), whether it is an angle, whether it and all before it
  // on its chain are slides, its joint.
  std::vector<int> dof_body, dof_joint;
  std::vector<int> group_begin, group_end;
  std::vector<int> articulated_dofs;  // dofs of bodies that do not float
  std::vector<std::uint8_t> angular, translation_only;
  // carries(j, k): moving dof j carries dof k's axis along (j is before k on its chain, or in its group).
  std::vector<std::uint8_t> ancestor_;
  bool is_ancestor(int j, int k) const { return ancestor_[static_cast<std::size_t>(j) * nv + k] != 0; }

  double step = 5e-3;       // h [s]
  double tolerance = 1e-7;  // Newton: residual relative to the forces at work
  int max_iterations = 50;
  int max_step_iterations = 1000;  // of all attempts and substeps of one step
  int max_halvings = 6;
  int polish = 0;  // Newton iterations after it has converged

  PairDofs pair_dofs(int first, int second);
};

// Collects a scene piece by piece, checks each, and hands out the Model.
class ModelSpec {
 public:
  V3<double> gravity{0, 0, -9.8};
  double step = 5e-3;
  double tolerance = 1e-7;
  int max_iterations = 50;
  int max_step_iterations = 1000;  // of all attempts and substeps of one step
  int max_halvings = 6;
  int polish = 0;
  std::string integrator = "bdf1";

  static constexpr double inf = std::numeric_limits<double>::infinity();

  int add_body(const std::string& name, int parent, const V3<double>& pos, const V4<double>& quat, double mass,
               const V3<double>& com, const V6<double>& inertia);
  int add_joint(const std::string& name, int body, const std::string& type, const V3<double>& pos,
                const V3<double>& axis, double damping, double armature, double stiffness, double springref,
                double lower, double upper, double limit_stiffness, double limit_damping, double ref,
                double frictionloss);
  int add_shape(const std::string& name, int body, const std::string& kind, const V3<double>& pos,
                const V4<double>& quat, const V3<double>& size, double rounding,
                std::shared_ptr<const DistanceGrid> grid);
  int add_points(const std::string& name, int body, const std::vector<V3<double>>& points,
                 const std::vector<double>& weights, double radius, const V3<double>& pos, const V4<double>& quat,
                 const std::vector<V3<double>>& areas);
  int add_contact(const std::string& name, int points, int shape, const std::string& law, const std::string& damping,
                  const std::array<double, 5>& law_numbers);
  int add_pad(const std::string& name, int body, const std::vector<V3<double>>& positions,
              const std::vector<M3<double>>& frames, const std::vector<int>& shapes, const std::string& law,
              const std::array<double, 5>& law_numbers, const std::vector<double>& weights, const V3<double>& pos,
              const V4<double>& quat, bool pushes);
  int add_actuator(const std::string& name, int joint, const std::string& kind, double gear, double kp, double kd,
                   double force_lower, double force_upper, double ctrl_lower, double ctrl_upper, double gain,
                   double bias);
  Model build() const;

 private:
  Model model_;
  int add_params(const std::string& owner, const std::vector<std::string>& names, const std::vector<double>& values);
  void check_body(const std::string& what, int body, bool world_allowed) const;
  int add_pose_params(const std::string& owner, const V3<double>& pos, bool scales);
};

}  // namespace gelflow
