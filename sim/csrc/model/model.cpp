#include "model/model.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace gelflow {

namespace {

[[noreturn]] void refuse(const std::string& what) { throw std::invalid_argument(what); }

void check_finite(const std::string& owner, const char* what, const double* values, int n) {
  for (int i = 0; i < n; ++i) {
    if (!std::isfinite(values[i])) refuse(owner + ": " + what + " has an entry that is not finite");
  }
}

template <class Item>
int next_index(const std::vector<Item>& items) {
  return static_cast<int>(items.size());
}

FrictionLaw friction_law(const std::string& owner, const std::string& name) {
  if (name == "viscous") return FrictionLaw::viscous;
  if (name == "elastic") return FrictionLaw::elastic;
  refuse(owner + ": friction law '" + name + "' is not one of viscous, elastic");
}

// Of a unit quaternion.
M3<double> rotation_from(const std::string& owner, const V4<double>& quat) {
  if (!(std::abs(quat.norm() - 1) < 1e-6)) refuse(owner + ": quat must have length 1");
  return rotation_of<double>(quat.normalized());
}

void check_law(const std::string& owner, const std::array<double, 5>& numbers, FrictionLaw law) {
  static const char* names[5] = {"kn", "kt", "mu", "kd", "ks"};
  for (int i = 0; i < 5; ++i) {
    if (!(numbers[i] >= 0) || !std::isfinite(numbers[i])) {
      refuse(owner + ": " + names[i] + " must be finite and not negative, got " + std::to_string(numbers[i]));
    }
  }
  if (law == FrictionLaw::elastic && !(numbers[4] > 0)) refuse(owner + ": the elastic friction law needs ks > 0");
}

}  // namespace

PairDofs Model::pair_dofs(int first, int second) {
  std::vector<int> dofs;
  std::vector<double> signs(nv, 0.0);
  for (int k = 0; k < nv; ++k) {
    const auto moves = [&](int body) {
      if (body == world) return false;
      const auto& own = bodies[body].dofs;
      return std::find(own.begin(), own.end(), k) != own.end();
    };
    const bool moves_first = moves(first), moves_second = moves(second);
    if (moves_first == moves_second) continue;
    dofs.push_back(k);
    signs[k] = moves_first ? 1.0 : -1.0;
  }
  const auto pack = [&](int width) {
    PackedDofs packed;
    for (const int k : dofs) {
      if (!packed.start.empty() && k < packed.start.back() + width) continue;
      packed.start.push_back(k);
    }
    for (const int start : packed.start) {
      for (int k = start; k < start + width; ++k) {
        const double sign = k < nv ? signs[k] : 0.0;
        packed.sign.push_back(sign);
        packed.dof.push_back(sign != 0 ? k : -1);
      }
    }
    for (const int row : packed.dof) {
      packed.linear.push_back(row >= 0 && angular[row] == 0);
      packed.has_coupling.push_back(0);
      for (const int column : packed.dof) {
        const bool both = row >= 0 && column >= 0;
        const bool counts = both && (signs[column] > 0 ? signs[row] > 0 && is_ancestor(column, row)
                                                       : signs[row] > 0 || !is_ancestor(column, row));
        packed.axis_coupling.push_back(counts ? 1.0 : 0.0);
        if (counts) packed.has_coupling.back() = 1;
      }
    }
    jacobian_columns = std::max(jacobian_columns, static_cast<int>(packed.dof.size()));
    return packed;
  };
  return {pack(1), pack(4), pack(8)};
}

int ModelSpec::add_params(const std::string& owner, const std::vector<std::string>& names,
                          const std::vector<double>& values) {
  const int offset = next_index(model_.param_names);
  for (std::size_t i = 0; i < names.size(); ++i) {
    const std::string name = owner + "." + names[i];
    if (std::find(model_.param_names.begin(), model_.param_names.end(), name) != model_.param_names.end()) {
      refuse("the name '" + owner + "' is used twice (parameter " + name + ")");
    }
    model_.param_names.push_back(name);
    model_.param_defaults.push_back(values[i]);
  }
  return offset;
}

void ModelSpec::check_body(const std::string& what, int body, bool world_allowed) const {
  if (body >= next_index(model_.bodies) || body < (world_allowed ? world : 0)) {
    refuse(what + ": body " + std::to_string(body) + " does not exist");
  }
}

int ModelSpec::add_pose_params(const std::string& owner, const V3<double>& pos, bool scales) {
  check_finite(owner, "pos", pos.data(), 3);
  const int offset =
      add_params(owner, {"pos.x", "pos.y", "pos.z", "turn.x", "turn.y", "turn.z"}, {pos[0], pos[1], pos[2], 0, 0, 0});
  if (scales) add_params(owner, {"scale.x", "scale.y", "scale.z"}, {1, 1, 1});
  return offset;
}

int ModelSpec::add_body(const std::string& name, int parent, const V3<double>& pos, const V4<double>& quat, double mass,
                        const V3<double>& com, const V6<double>& inertia) {
  check_body("body '" + name + "'", parent, true);
  check_finite("body '" + name + "'", "pos", pos.data(), 3);
  check_finite("body '" + name + "'", "com", com.data(), 3);
  check_finite("body '" + name + "'", "inertia", inertia.data(), 6);
  if (!(mass >= 0) || !std::isfinite(mass)) refuse("body '" + name + "': mass must be finite and not negative");
  if (!(std::abs(quat.norm() - 1) < 1e-6)) refuse("body '" + name + "': quat must have length 1");
  Body body;
  body.name = name;
  body.parent = parent;
  body.quat = quat.normalized();
  body.rotation = rotation_of<double>(body.quat);
  body.joint_begin = body.joint_end = 0;
  body.mass = add_params(
      name,
      {"mass", "com.x", "com.y", "com.z", "inertia.xx", "inertia.yy", "inertia.zz", "inertia.xy", "inertia.xz",
       "inertia.yz"},
      {mass, com[0], com[1], com[2], inertia[0], inertia[1], inertia[2], inertia[3], inertia[4], inertia[5]});
  body.pos = add_params(name, {"pos.x", "pos.y", "pos.z"}, {pos[0], pos[1], pos[2]});
  model_.bodies.push_back(body);
  return next_index(model_.bodies) - 1;
}

int ModelSpec::add_joint(const std::string& name, int body, const std::string& type, const V3<double>& pos,
                         const V3<double>& axis, double damping, double armature, double stiffness, double springref,
                         double lower, double upper, double limit_stiffness, double limit_damping, double ref,
                         double frictionloss) {
  check_body("joint '" + name + "'", body, false);
  if (!model_.joints.empty() && body < model_.joints.back().body) {
    refuse("joint '" + name + "': joints must be added in the order of their bodies");
  }
  Joint joint;
  joint.name = name;
  joint.body = body;
  joint.pos = pos;
  joint.axis = axis;
  joint.q = model_.nq;
  joint.v = model_.nv;
  if (type == "slide") {
    joint.type = JointType::slide;
  } else if (type == "hinge") {
    joint.type = JointType::hinge;
  } else if (type == "ball") {
    joint.type = JointType::ball;
  } else if (type == "free") {
    joint.type = JointType::free;
  } else {
    refuse("joint '" + name + "': type '" + type + "' is not one of slide, hinge, ball, free");
  }
  const bool free = joint.type == JointType::free;
  Body& owner = model_.bodies[body];
  if (owner.joint_begin == owner.joint_end) owner.joint_begin = next_index(model_.joints);
  if (free && (owner.parent != world || owner.joint_begin != next_index(model_.joints))) {
    refuse("joint '" + name + "': a free joint must be the only joint of a body whose parent is the world");
  }
  if (!joint.has_quaternion()) {
    if (!(axis.norm() > 1e-9)) refuse("joint '" + name + "': axis must not be zero");
    joint.axis = axis.normalized();
    if (!(lower < upper)) refuse("joint '" + name + "': lower limit must be below upper");
  }
  joint.dofs = joint.scalar_dofs() + (joint.has_quaternion() ? 3 : 0);
  joint.ref = joint.has_quaternion() ? 0 : ref;
  joint.param =
      add_params(name,
                 {"damping", "armature", "stiffness", "springref", "lower", "upper", "limit_stiffness", "limit_damping",
                  "frictionloss"},
                 {damping, armature, stiffness, springref, lower, upper, limit_stiffness, limit_damping, frictionloss});
  for (int i = 0; i < joint.dofs; ++i) {
    const int k = model_.nv + i;
    const bool turning = joint.has_quaternion() && i >= joint.scalar_dofs();
    model_.dof_body.push_back(body);
    model_.dof_joint.push_back(next_index(model_.joints));
    model_.group_begin.push_back(turning ? joint.angular_v() : k);
    model_.group_end.push_back(turning ? joint.angular_v() + 3 : k + 1);
    model_.angular.push_back(turning || joint.type == JointType::hinge ? 1 : 0);
  }
  if (free) {
    const double* p = &model_.param_defaults[owner.pos];
    model_.q0.insert(model_.q0.end(), {p[0], p[1], p[2], owner.quat[0], owner.quat[1], owner.quat[2], owner.quat[3]});
  } else if (joint.type == JointType::ball) {
    model_.q0.insert(model_.q0.end(), {1, 0, 0, 0});
  } else {
    model_.q0.push_back(ref);
  }
  model_.nq += joint.scalar_dofs() + (joint.has_quaternion() ? 4 : 0);
  model_.nv += joint.dofs;
  model_.joints.push_back(joint);
  owner.joint_end = next_index(model_.joints);
  return next_index(model_.joints) - 1;
}

int ModelSpec::add_shape(const std::string& name, int body, const std::string& kind, const V3<double>& pos,
                         const V4<double>& quat, const V3<double>& size, double rounding,
                         std::shared_ptr<const DistanceGrid> grid) {
  const std::string owner = "shape '" + name + "'";
  check_body(owner, body, true);
  check_finite(owner, "size", size.data(), 3);
  Shape shape;
  shape.name = name;
  shape.body = body;
  shape.rotation = rotation_from("shape '" + name + "'", quat);
  struct Kind {
    const char* name;
    ShapeKind kind, rounded;
    int sizes;
  };
  constexpr ShapeKind none = ShapeKind::plane;  // can't be rounded
  constexpr Kind kinds[] = {{"plane", ShapeKind::plane, none, 0},
                            {"sphere", ShapeKind::sphere, none, 1},
                            {"box", ShapeKind::box, ShapeKind::rounded_box, 3},
                            {"cylinder", ShapeKind::cylinder, ShapeKind::rounded_cylinder, 2},
                            {"capsule", ShapeKind::capsule, none, 2},
                            {"ellipsoid", ShapeKind::ellipsoid, none, 3},
                            {"grid", ShapeKind::grid, none, 1}};
  const auto* found = std::find_if(std::begin(kinds), std::end(kinds), [&](const Kind& k) { return kind == k.name; });
  if (found == std::end(kinds)) {
    refuse(owner + ": kind '" + kind + "' is not one of plane, sphere, box, cylinder, capsule, ellipsoid, grid");
  }
  const int sizes = found->sizes;
  for (int i = 0; i < sizes; ++i) {
    if (!(size[i] > 0)) refuse(owner + ": size must be positive");
  }
  if ((found->kind == ShapeKind::grid) != (grid != nullptr)) refuse(owner + ": a grid goes with the kind grid");
  if (!(rounding >= 0)) refuse(owner + ": rounding must not be negative");
  if (rounding > 0 && found->rounded == none) refuse(owner + ": only a box or a cylinder can be rounded");
  if (rounding > 0 && !(rounding < size.head(sizes).minCoeff())) {
    refuse(owner + ": rounding must be below the smallest half size");
  }
  shape.kind = rounding > 0 ? found->rounded : found->kind;
  shape.grid = std::move(grid);
  shape.size = add_params(name, {"size.x", "size.y", "size.z"}, {size[0], size[1], size[2]});
  if (rounding > 0) add_params(name, {"rounding"}, {rounding});
  shape.pose_param = add_pose_params(name + ".shape", pos, false);
  model_.shapes.push_back(shape);
  return next_index(model_.shapes) - 1;
}

int ModelSpec::add_points(const std::string& name, int body, const std::vector<V3<double>>& points,
                          const std::vector<double>& weights, double radius, const V3<double>& pos,
                          const V4<double>& quat, const std::vector<V3<double>>& areas) {
  check_body("points '" + name + "'", body, true);
  if (points.empty()) refuse("points '" + name + "': at least one point is needed");
  if (points.size() != weights.size()) refuse("points '" + name + "': as many weights as points are needed");
  for (const auto& p : points) check_finite("points '" + name + "'", "position", p.data(), 3);
  for (const double w : weights) {
    if (!(w >= 0) || !std::isfinite(w)) refuse("points '" + name + "': weights must be finite and not negative");
  }
  if (!(radius >= 0) || (radius > 0 && points.size() != 1)) {
    refuse("points '" + name + "': a radius goes with a single point, the sphere's centre");
  }
  if (!areas.empty() && areas.size() != points.size())
    refuse("points '" + name + "': as many areas as points are needed");
  const M3<double> rotation = rotation_from("points '" + name + "'", quat);
  const Mount mount{body, pos, rotation, add_pose_params(name + ".points", pos, true), true};
  PointCloud cloud(points, weights);
  for (std::size_t i = 0; i < areas.size(); ++i) cloud.areas.push_back(areas[cloud.original[i]]);
  model_.point_sets.push_back({name, mount, radius, std::move(cloud)});
  return next_index(model_.point_sets) - 1;
}

int ModelSpec::add_contact(const std::string& name, int points, int shape, const std::string& law,
                           const std::string& damping, const std::array<double, 5>& law_numbers) {
  const std::string owner = "contact '" + name + "'";
  if (points < 0 || points >= next_index(model_.point_sets)) refuse(owner + ": no such point set");
  if (shape < 0 || shape >= next_index(model_.shapes)) refuse(owner + ": no such shape");
  if (model_.point_sets[points].radius > 0 && model_.shapes[shape].kind != ShapeKind::plane) {
    refuse(owner + ": a sphere's moving point touches planes only");
  }
  Contact contact;
  contact.name = name;
  contact.points = points;
  contact.shape = shape;
  contact.law = friction_law(owner, law);
  check_law(owner, law_numbers, contact.law);
  if (damping != "depth" && damping != "plain") refuse(owner + ": damping '" + damping + "' is not depth or plain");
  if (model_.point_sets[points].radius > 0 && contact.law == FrictionLaw::elastic) {
    refuse(owner + ": a sphere's moving point can not keep an anchor; let its friction be viscous");
  }
  contact.damping = damping == "depth" ? DampingLaw::depth : DampingLaw::plain;
  contact.param = add_params(name, {"kn", "kt", "mu", "kd", "ks"}, {law_numbers.begin(), law_numbers.end()});
  contact.anchor = -1;
  if (contact.law == FrictionLaw::elastic) {
    contact.anchor = model_.na;
    model_.na += model_.point_sets[points].cloud.size();
  }
  model_.contacts.push_back(contact);
  return next_index(model_.contacts) - 1;
}

int ModelSpec::add_pad(const std::string& name, int body, const std::vector<V3<double>>& positions,
                       const std::vector<M3<double>>& frames, const std::vector<int>& shapes, const std::string& law,
                       const std::array<double, 5>& law_numbers, const std::vector<double>& weights,
                       const V3<double>& pos, const V4<double>& quat, bool pushes) {
  const std::string owner = "pad '" + name + "'";
  check_body(owner, body, true);
  if (positions.empty()) refuse(owner + ": at least one marker is needed");
  if (frames.size() != positions.size() || weights.size() != positions.size()) {
    refuse(owner + ": every marker needs a position, a frame and a weight");
  }
  for (const int s : shapes) {
    if (s < 0 || s >= next_index(model_.shapes)) refuse(owner + ": no such shape");
  }
  for (const double w : weights) {
    if (!(w >= 0) || !std::isfinite(w)) refuse(owner + ": weights must be finite and not negative");
  }
  Pad pad;
  pad.name = name;
  const M3<double> rotation = rotation_from(owner, quat);
  pad.cloud = PointCloud(positions, weights);
  for (const int i : pad.cloud.original) pad.frames.push_back(frames[i]);
  pad.flat = std::all_of(frames.begin(), frames.end(), [&](const M3<double>& f) { return f == frames[0]; });
  pad.shapes = shapes;
  pad.law = friction_law(owner, law);
  check_law(owner, law_numbers, pad.law);
  pad.param = add_params(name, {"kn", "kt", "mu", "kd", "ks"}, {law_numbers.begin(), law_numbers.end()});
  pad.mount = {body, pos, rotation, add_pose_params(name + ".markers", pos, false), false};
  pad.anchor = -1;
  if (pad.law == FrictionLaw::elastic) {
    pad.anchor = model_.na;
    model_.na += pad.cloud.size() * static_cast<int>(shapes.size());
  }
  pad.first_marker = model_.markers;
  model_.markers += pad.cloud.size();
  pad.pushes = pushes;
  model_.pads.push_back(pad);
  if (!pushes) return next_index(model_.pads) - 1;
  model_.point_sets.push_back({name, pad.mount, 0.0, pad.cloud});
  for (std::size_t s = 0; s < shapes.size(); ++s) {
    const std::string own = shapes.size() == 1 ? name : name + "/" + model_.shapes[shapes[s]].name;
    const int anchor = pad.anchor < 0 ? -1 : pad.anchor + static_cast<int>(s) * pad.cloud.size();
    model_.contacts.push_back(
        {own, next_index(model_.point_sets) - 1, shapes[s], pad.law, DampingLaw::depth, pad.param, anchor, {}});
  }
  return next_index(model_.pads) - 1;
}

int ModelSpec::add_actuator(const std::string& name, int joint, const std::string& kind, double gear, double kp,
                            double kd, double force_lower, double force_upper, double ctrl_lower, double ctrl_upper,
                            double gain, double bias) {
  const std::string owner = "actuator '" + name + "'";
  if (joint < 0 || joint >= next_index(model_.joints)) refuse(owner + ": no such joint");
  if (model_.joints[joint].has_quaternion()) refuse(owner + ": only slide and hinge joints can be actuated");
  if (!(force_lower < force_upper)) refuse(owner + ": force_lower must be below force_upper");
  if (!(ctrl_lower < ctrl_upper)) refuse(owner + ": ctrl_lower must be below ctrl_upper");
  Actuator actuator;
  actuator.name = name;
  if (kind == "motor") {
    actuator.kind = ActuatorKind::motor;
  } else if (kind == "position") {
    actuator.kind = ActuatorKind::position;
  } else if (kind == "velocity") {
    actuator.kind = ActuatorKind::velocity;
  } else if (kind == "general") {
    actuator.kind = ActuatorKind::general;
  } else {
    refuse(owner + ": kind '" + kind + "' is not motor, position, velocity or general");
  }
  actuator.dof = model_.joints[joint].v;
  actuator.q = model_.joints[joint].q;
  actuator.param =
      add_params(name, {"gear", "kp", "kd", "force_lower", "force_upper", "ctrl_lower", "ctrl_upper", "gain", "bias"},
                 {gear, kp, kd, force_lower, force_upper, ctrl_lower, ctrl_upper, gain, bias});
  model_.actuators.push_back(actuator);
  return next_index(model_.actuators) - 1;
}

Model ModelSpec::build() const {
  Model model = model_;
  if (model.nv == 0) refuse("the scene has no joint: nothing can move");
  model.gravity = next_index(model.param_names);
  for (const char* axis : {"gravity.x", "gravity.y", "gravity.z"}) model.param_names.emplace_back(axis);
  for (int i = 0; i < 3; ++i) model.param_defaults.push_back(gravity[i]);
  if (!(step > 0) || !std::isfinite(step)) refuse("step must be positive and finite");
  if (!(tolerance > 0)) refuse("tolerance must be positive");
  model.step = step;
  model.tolerance = tolerance;
  model.max_iterations = max_iterations;
  model.max_halvings = max_halvings;
  model.polish = polish;
  model.max_step_iterations = max_step_iterations;
  if (integrator != "bdf1" && integrator != "bdf2") refuse("integrator '" + integrator + "' is not bdf1 or bdf2");
  model.nh = integrator == "bdf2" ? 2 * model.nv + 1 : 0;
  const int nv = model.nv;
  for (Body& body : model.bodies) {  // parents come first, so their dofs are complete
    if (body.joint_begin == body.joint_end) refuse("body '" + body.name + "' has no joint: merge it into its parent");
    if (body.parent != world) body.dofs = model.bodies[body.parent].dofs;
    for (int j = body.joint_begin; j < body.joint_end; ++j) {
      for (int i = 0; i < model.joints[j].dofs; ++i) body.dofs.push_back(model.joints[j].v + i);
    }
  }
  model.translation_only.assign(nv, 0);
  for (Body& body : model.bodies) {
    body.translation_only = true;
    for (const int k : body.dofs) {  // root first
      body.translation_only = body.translation_only && !model.angular[k];
      model.translation_only[k] = body.translation_only;
    }
  }
  for (std::size_t i = 0; i < model.bodies.size(); ++i) {
    const auto carried = [&](const Body& other) { return other.parent == static_cast<int>(i); };
    Body& body = model.bodies[i];
    body.is_free = body.joint_end == body.joint_begin + 1 && model.joints[body.joint_begin].type == JointType::free &&
                   std::none_of(model.bodies.begin(), model.bodies.end(), carried);
  }
  for (int k = 0; k < nv; ++k) {
    if (!model.bodies[model.dof_body[k]].is_free) model.articulated_dofs.push_back(k);
  }
  model.ancestor_.assign(static_cast<std::size_t>(nv) * nv, 0);
  for (int k = 0; k < nv; ++k) {
    for (const int j : model.bodies[model.dof_body[k]].dofs) {
      if (j <= k || model.group_begin[j] == model.group_begin[k]) {
        model.ancestor_[static_cast<std::size_t>(j) * nv + k] = 1;
      }
    }
  }
  for (auto& contact : model.contacts) {
    const PointSet& set = model.point_sets[contact.points];
    const Shape& shape = model.shapes[contact.shape];
    contact.pair = model.pair_dofs(set.mount.body, shape.body);
    contact.uses_arc_correction = set.mount.body != world && model.bodies[set.mount.body].is_free &&
                                  shape.body == world && shape.kind == ShapeKind::plane &&
                                  (set.radius == 0 || set.cloud.extent > 0);
  }
  for (auto& pad : model.pads) {
    for (const int s : pad.shapes) pad.pairs.push_back(model.pair_dofs(pad.mount.body, model.shapes[s].body));
  }
  return model;
}

}  // namespace gelflow
