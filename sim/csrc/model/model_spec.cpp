#include "model/model_spec.hpp"

#include <algorithm>
#include <map>
#include <type_traits>

#include "model/definition_checks.hpp"

namespace gelflow {

namespace {

template <class Item>
int count(const std::vector<Item>& items) {
  return static_cast<int>(items.size());
}

}  // namespace

// Elements of different kinds may have the same name; elements of one kind may not.
template <template <class> class Params>
ParamBlock<Params> ModelSpec::add_params(const char* kind, const std::string& owner, const Params<double>& values) {
  constexpr bool of_actuator = std::is_same_v<Params<double>, ActuatorParams<double>>;
  const ParamBlock<Params> block{count(model_.param_names)};
  const auto* numbers = reinterpret_cast<const double*>(&values);
  for (std::size_t i = 0; i < Params<double>::names.size(); ++i) {
    const char* const param = Params<double>::names[i];
    const std::string name = owner + "." + param;
    const std::string wrong = not_finite(name, numbers[i]);
    if (!wrong.empty()) reject(wrong);
    if (!used_names_.insert(kind + (":" + name)).second) {
      reject("the name '" + owner + "' is used twice (parameter " + name + ")");
    }
    model_.param_names.push_back(name);
    model_.param_defaults.push_back(numbers[i]);
    model_.param_signs.push_back(of_actuator ? ParamSign::any : param_sign(param, numbers[i]));
    param_kinds_.push_back(kind);
  }
  return block;
}

// Parameters of elements of different kinds that have one name get the kind before it, as in "pad:finger.kd".
void ModelSpec::name_kinds(Model& model) const {
  std::map<std::string, int> uses;
  for (const std::string& name : model.param_names) ++uses[name];
  for (std::size_t i = 0; i < model.param_names.size(); ++i) {
    if (uses[model.param_names[i]] > 1)
      model.param_names[i] = std::string(param_kinds_[i]) + ":" + model.param_names[i];
  }
}

void ModelSpec::check_body(const std::string& owner, int body, bool world_allowed) const {
  if (body >= count(model_.bodies) || body < (world_allowed ? world : 0)) {
    reject(owner + ": body " + std::to_string(body) + " does not exist");
  }
}

ParamBlock<PoseParams> ModelSpec::add_pose(const char* kind, const std::string& owner, const V3<double>& pos) {
  check_finite(owner, "pos", pos);
  return add_params(kind, owner, PoseParams<double>{pos, V3<double>::Zero()});
}

int ModelSpec::add_anchors(FrictionLaw law, int anchors) {
  if (law != FrictionLaw::elastic) return -1;
  const int first = model_.na;
  model_.na += anchors;
  return first;
}

int ModelSpec::add_body(const BodyDef& def) {
  const std::string owner = "body '" + def.name + "'";
  check_body(owner, def.parent, true);
  check_finite(owner, "pos", def.pose.pos);
  check_finite(owner, "com", def.com);
  check_finite(owner, "inertia", def.inertia);
  if (!(def.mass >= 0) || !std::isfinite(def.mass)) reject(owner + ": mass must be finite and not negative");
  Body body;
  body.name = def.name;
  body.parent = def.parent;
  body.quat = unit_quaternion(owner, def.pose.quat);
  body.rotation = rotation_of<double>(body.quat);
  body.joint_begin = body.joint_end = 0;
  const V6<double>& i = def.inertia;
  body.params = add_params("body", def.name,
                           BodyParams<double>{def.mass, def.com, i[0], i[1], i[2], i[3], i[4], i[5], def.pose.pos});
  check_finite(owner, "gravcomp_pos", def.compensation.pos);
  if (!std::isfinite(def.compensation.factor)) reject(owner + ": gravcomp must be finite");
  if (def.compensation.factor != 0) {
    body.compensation = add_params("body", def.name, def.compensation);
    model_.compensated_bodies.push_back(count(model_.bodies));
  }
  model_.bodies.push_back(body);
  definitions_.bodies.push_back(def);
  return count(model_.bodies) - 1;
}

int ModelSpec::add_joint(const JointDef& def) {
  const std::string owner = "joint '" + def.name + "'";
  check_body(owner, def.body, false);
  if (!model_.joints.empty() && def.body < model_.joints.back().body) {
    reject(owner + ": joints must be added in the order of their bodies");
  }
  check_finite(owner, "pos", def.pos);
  check_finite(owner, "axis", def.axis);
  if (!std::isfinite(def.ref)) reject(owner + ": ref must be finite");
  Joint joint;
  joint.name = def.name;
  joint.type = joint_type(owner, def.type);
  joint.body = def.body;
  joint.pos = def.pos;
  joint.axis = def.axis;
  joint.q = model_.nq;
  joint.v = model_.nv;
  const bool free = joint.type == JointType::free;
  Body& body = model_.bodies[def.body];
  if (body.joint_begin == body.joint_end) body.joint_begin = count(model_.joints);
  if (free && (body.parent != world || body.joint_begin != count(model_.joints))) {
    reject(owner + ": a free joint must be the only joint of a body whose parent is the world");
  }
  if (!joint.has_quaternion()) {
    if (!(def.axis.norm() > 1e-9)) reject(owner + ": axis must not be zero");
    joint.axis = def.axis.normalized();
    if (!(def.params.lower < def.params.upper)) reject(owner + ": lower limit must be below upper");
  }
  joint.dofs = joint.scalar_dofs() + (joint.has_quaternion() ? 3 : 0);
  joint.ref = joint.has_quaternion() ? 0 : def.ref;
  joint.params = add_params("joint", def.name, def.params);
  if (free) {
    const V3<double>& p = body.params.in(model_.param_defaults.data()).pos;
    model_.q0.insert(model_.q0.end(), {p[0], p[1], p[2], body.quat[0], body.quat[1], body.quat[2], body.quat[3]});
  } else if (joint.type == JointType::ball) {
    model_.q0.insert(model_.q0.end(), {1, 0, 0, 0});
  } else {
    model_.q0.push_back(def.ref);
  }
  add_dofs(joint, def.prescribed);
  model_.joints.push_back(joint);
  body.joint_end = count(model_.joints);
  definitions_.joints.push_back(def);
  return count(model_.joints) - 1;
}

void ModelSpec::add_dofs(const Joint& joint, bool prescribed) {
  for (int i = 0; i < joint.dofs; ++i) {
    const bool rotational = joint.has_quaternion() && i >= joint.scalar_dofs();
    model_.dof_body.push_back(joint.body);
    model_.dof_joint.push_back(count(model_.joints));
    model_.group_begin.push_back(rotational ? joint.angular_v() : joint.v + i);
    model_.group_end.push_back(rotational ? joint.angular_v() + 3 : joint.v + i + 1);
    model_.angular.push_back(rotational || joint.type == JointType::hinge ? 1 : 0);
    if (prescribed) model_.prescribed_dofs.push_back(joint.v + i);
  }
  model_.nq += joint.scalar_dofs() + (joint.has_quaternion() ? 4 : 0);
  model_.nv += joint.dofs;
}

int ModelSpec::add_shape(const ShapeDef& def) {
  const std::string owner = "shape '" + def.name + "'";
  check_body(owner, def.body, true);
  check_finite(owner, "size", def.size);
  Shape shape;
  shape.name = def.name;
  shape.body = def.body;
  shape.rotation = rotation_of<double>(unit_quaternion(owner, def.pose.quat));
  shape.kind = shape_kind(owner, def);
  shape.grid = def.grid;
  shape.size = add_params("shape", def.name, SizeParams<double>{def.size});
  if (def.rounding > 0) add_params("shape", def.name, RoundingParams<double>{def.rounding});
  shape.pose = add_pose("shape", def.name + ".shape", def.pose.pos);
  model_.shapes.push_back(shape);
  definitions_.shapes.push_back(def);
  return count(model_.shapes) - 1;
}

int ModelSpec::add_points(const PointsDef& def) {
  const std::string owner = "points '" + def.name + "'";
  check_body(owner, def.body, true);
  if (def.points.empty()) reject(owner + ": at least one point is needed");
  const std::vector<double> weights = def.weights.value_or(std::vector<double>(def.points.size(), 1.0));
  if (def.points.size() != weights.size()) reject(owner + ": as many weights as points are needed");
  for (const auto& p : def.points) check_finite(owner, "position", p);
  check_weights(owner, weights);
  if (!(def.radius >= 0) || (def.radius > 0 && def.points.size() != 1)) {
    reject(owner + ": a radius goes with a single point, the sphere's centre");
  }
  if (def.areas && def.areas->size() != def.points.size()) reject(owner + ": as many areas as points are needed");
  for (std::size_t i = 0; def.areas && i < def.areas->size(); ++i) check_finite(owner, "area", (*def.areas)[i]);
  PointSet set;
  set.name = def.name;
  set.radius = def.radius;
  set.mount = {def.body, def.pose.pos, rotation_of<double>(unit_quaternion(owner, def.pose.quat)), {}, {}};
  set.mount.pose = add_pose("points", def.name + ".points", def.pose.pos);
  set.mount.scale = add_params("points", def.name + ".points", ScaleParams<double>{V3<double>::Ones()});
  set.cloud = PointCloud(def.points, weights);
  for (std::size_t i = 0; def.areas && i < def.areas->size(); ++i) {
    set.cloud.areas.push_back((*def.areas)[set.cloud.original[i]]);
  }
  model_.point_sets.push_back(std::move(set));
  definitions_.points.push_back(def);
  point_sets_.push_back(count(model_.point_sets) - 1);
  return count(definitions_.points) - 1;
}

int ModelSpec::add_contact(const ContactDef& def) {
  const std::string owner = "contact '" + def.name + "'";
  if (def.points < 0 || def.points >= count(definitions_.points)) reject(owner + ": no such point set");
  if (def.shape < 0 || def.shape >= count(model_.shapes)) reject(owner + ": no such shape");
  const PointSet& set = model_.point_sets[point_sets_[def.points]];
  Contact contact;
  contact.name = def.name;
  contact.points = point_sets_[def.points];
  contact.shape = def.shape;
  contact.law = friction_law(owner, def.law);
  contact.damping = damping_law(owner, def.damping);
  check_contact_params(owner, def.params, contact.law);
  if (set.radius > 0 && model_.shapes[def.shape].kind != ShapeKind::plane) {
    reject(owner + ": a sphere's moving point touches planes only");
  }
  if (set.radius > 0 && contact.law == FrictionLaw::elastic) {
    reject(owner + ": a sphere's moving point can not keep an anchor; let its friction be viscous");
  }
  contact.params = add_params("contact", def.name, def.params);
  contact.anchor = add_anchors(contact.law, set.cloud.size());
  model_.contacts.push_back(contact);
  definitions_.contacts.push_back(def);
  return count(model_.contacts) - 1;
}

int ModelSpec::add_pad(const PadDef& def) {
  const std::string owner = "pad '" + def.name + "'";
  const std::size_t markers = def.positions.size();
  check_body(owner, def.body, true);
  if (markers == 0) reject(owner + ": at least one marker is needed");
  const std::vector<double> weights = def.weights.value_or(std::vector<double>(markers, 1.0));
  const std::vector<M3<double>> axes = def.axes.value_or(std::vector<M3<double>>(markers, M3<double>::Identity()));
  if (axes.size() != markers || weights.size() != markers) {
    reject(owner + ": every marker needs a position, axes and a weight");
  }
  for (const auto& position : def.positions) check_finite(owner, "position", position);
  for (const auto& frame : axes) check_finite(owner, "axes", frame.reshaped());
  for (const int s : def.shapes) {
    if (s < 0 || s >= count(model_.shapes)) reject(owner + ": no such shape");
  }
  check_weights(owner, weights);
  Pad pad;
  pad.name = def.name;
  pad.mount = {def.body, def.pose.pos, rotation_of<double>(unit_quaternion(owner, def.pose.quat)), {}, {}};
  pad.cloud = PointCloud(def.positions, weights);
  for (const int i : pad.cloud.original) pad.frames.push_back(axes[i]);
  pad.flat = std::all_of(axes.begin(), axes.end(), [&](const M3<double>& frame) { return frame == axes[0]; });
  pad.shapes = def.shapes;
  pad.law = friction_law(owner, def.law);
  check_contact_params(owner, def.params, pad.law);
  pad.params = add_params("pad", def.name, def.params);
  pad.mount.pose = add_pose("pad", def.name + ".markers", def.pose.pos);
  pad.anchor = add_anchors(pad.law, pad.cloud.size() * count(def.shapes));
  pad.first_marker = model_.num_markers;
  model_.num_markers += pad.cloud.size();
  pad.collides = def.collides;
  if (pad.collides) add_pad_contacts(pad);
  model_.pads.push_back(pad);
  definitions_.pads.push_back(def);
  return count(model_.pads) - 1;
}

// The contacts of a pad whose markers are contact points: one per shape, with the pad's parameters and anchors.
void ModelSpec::add_pad_contacts(const Pad& pad) {
  model_.point_sets.push_back({pad.name, pad.mount, 0.0, pad.cloud});
  for (std::size_t s = 0; s < pad.shapes.size(); ++s) {
    const bool only = pad.shapes.size() == 1;
    Contact contact;
    contact.name = only ? pad.name : pad.name + "/" + model_.shapes[pad.shapes[s]].name;
    contact.points = count(model_.point_sets) - 1;
    contact.shape = pad.shapes[s];
    contact.law = pad.law;
    contact.damping = DampingLaw::hunt_crossley;
    contact.params = pad.params;
    contact.anchor = pad.anchor < 0 ? -1 : pad.anchor + static_cast<int>(s) * pad.cloud.size();
    model_.contacts.push_back(contact);
  }
}

const Joint& ModelSpec::scalar_joint(const std::string& owner, int joint) const {
  if (joint < 0 || joint >= count(model_.joints)) reject(owner + ": no such joint");
  if (model_.joints[joint].has_quaternion())
    reject(owner + ": joint '" + model_.joints[joint].name + "' is no slide or hinge");
  return model_.joints[joint];
}

int ModelSpec::add_tendon(const TendonDef& def) {
  const std::string owner = "tendon '" + def.name + "'";
  if (def.joints.empty()) reject(owner + ": at least one joint is needed");
  if (def.joints.size() != def.coefficients.size()) reject(owner + ": as many coefficients as joints are needed");
  if (!(def.params.lower < def.params.upper)) reject(owner + ": lower limit must be below upper");
  Tendon tendon;
  tendon.name = def.name;
  for (std::size_t i = 0; i < def.joints.size(); ++i) {
    const Joint& joint = scalar_joint(owner, def.joints[i]);
    if (!std::isfinite(def.coefficients[i])) reject(owner + ": coefficients must be finite");
    tendon.terms.push_back({joint.q, joint.v, def.coefficients[i]});
  }
  tendon.params = add_params("tendon", def.name, def.params);
  model_.tendons.push_back(tendon);
  definitions_.tendons.push_back(def);
  return count(model_.tendons) - 1;
}

int ModelSpec::add_coupling(const CouplingDef& def) {
  const std::string owner = "coupling '" + def.name + "'";
  const Joint& joint = scalar_joint(owner, def.joint);
  if (def.leader == def.joint) reject(owner + ": a joint cannot follow itself");
  std::vector<double> coefficients = def.coefficients;
  for (const double c : coefficients) {
    if (!std::isfinite(c)) reject(owner + ": coefficients must be finite");
  }
  coefficients.resize(std::max<std::size_t>(coefficients.size(), 2), 0.0);
  while (coefficients.size() > 2 && coefficients.back() == 0) coefficients.pop_back();
  int leader_q = -1, leader_dof = -1;
  if (def.leader >= 0) {
    const Joint& leader = scalar_joint(owner, def.leader);
    leader_q = leader.q;
    leader_dof = leader.v;
  } else if (coefficients.size() > 2 || coefficients[1] != 0) {
    reject(owner + ": without a leader only the coefficient of power 0 can be given");
  }
  if (coefficients.size() == 2) {
    model_.couplings.push_back({def.name, joint.q, joint.v, leader_q, leader_dof, coefficients[1], coefficients[0]});
  } else {
    if (!(def.params.stiffness > 0)) reject(owner + ": above degree 1 the stiffness must be positive");
    const ParamBlock<SpringParams> params = add_params("coupling", def.name, def.params);
    model_.polynomial_couplings.push_back({def.name, joint.q, joint.v, leader_q, leader_dof, coefficients, params});
  }
  definitions_.couplings.push_back(def);
  return count(definitions_.couplings) - 1;
}

int ModelSpec::add_loop_closure(const LoopClosureDef& def) {
  const std::string owner = "loop closure '" + def.name + "'";
  check_body(owner, def.first, true);
  check_body(owner, def.second, true);
  if (def.first == def.second) reject(owner + ": its two bodies are the same");
  check_finite(owner, "first", def.params.first);
  check_finite(owner, "second", def.params.second);
  if (!(def.params.stiffness > 0)) reject(owner + ": stiffness must be positive");
  if (def.weld && !(def.params.turn_stiffness > 0)) reject(owner + ": turn_stiffness of a weld must be positive");
  LoopClosure closure;
  closure.name = def.name;
  closure.first = def.first;
  closure.second = def.second;
  closure.weld = def.weld;
  closure.rotation = rotation_of<double>(unit_quaternion(owner, def.quat));
  closure.params = add_params("loop closure", def.name, def.params);
  model_.loop_closures.push_back(closure);
  definitions_.loop_closures.push_back(def);
  return count(model_.loop_closures) - 1;
}

int ModelSpec::add_actuator(const ActuatorDef& def) {
  const std::string owner = "actuator '" + def.name + "'";
  if (def.tendon >= count(model_.tendons)) reject(owner + ": no such tendon");
  const ActuatorParams<double>& p = def.params;
  if (!(p.force_lower < p.force_upper)) reject(owner + ": force_lower must be below force_upper");
  if (!(p.ctrl_lower < p.ctrl_upper)) reject(owner + ": ctrl_lower must be below ctrl_upper");
  Actuator actuator;
  actuator.name = def.name;
  actuator.kind = actuator_kind(owner, def.kind);
  actuator.tendon = def.tendon < 0 ? -1 : def.tendon;
  const bool on_joint = actuator.tendon < 0;
  actuator.dof = on_joint ? scalar_joint(owner, def.joint).v : -1;
  actuator.q = on_joint ? scalar_joint(owner, def.joint).q : -1;
  actuator.params = add_params("actuator", def.name, p);
  model_.actuators.push_back(actuator);
  definitions_.actuators.push_back(def);
  return count(model_.actuators) - 1;
}

Model ModelSpec::build() const {
  if (model_.nv == 0) reject("the scene has no joint: nothing can move");
  if (!(options.step > 0) || !std::isfinite(options.step)) reject("step must be positive and finite");
  if (!(options.tolerance > 0 && options.tolerance <= largest_tolerance)) {
    reject("tolerance must be above 0 and at most 0.1");
  }
  if (integrator != "bdf1" && integrator != "bdf2") reject("integrator '" + integrator + "' is not bdf1 or bdf2");
  ModelSpec complete = *this;  // a spec may be built again after changes
  complete.model_.gravity = complete.add_params("scene", "gravity", GravityParams<double>{gravity});
  Model model = std::move(complete.model_);
  static_cast<SolverOptions&>(model) = options;
  complete.name_kinds(model);
  model.nh = integrator == "bdf2" ? 2 * model.nv + 1 : 0;
  build_kinematic_tree(model);
  build_contact_pairs(model);
  build_couplings(model);
  return model;
}

}  // namespace gelflow
