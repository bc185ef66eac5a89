// Definitions of the elements of a scene, as classes with keyword-only constructors and named fields.
#include "model/definitions.hpp"

#include "python/arrays.hpp"
#include "python/bindings.hpp"

namespace gelflow {

namespace {

using Points = Array<double>;
using Weights = std::vector<double>;

const V3<double> origin = V3<double>::Zero();
const V4<double> identity = V4<double>::Unit(0);

template <class Def>
void bind_pose(py::class_<Def>& type) {
  type.def_property(
          "pos", [](const Def& d) { return d.pose.pos; }, [](Def& d, const V3<double>& x) { d.pose.pos = x; })
      .def_property(
          "quat", [](const Def& d) { return d.pose.quat; }, [](Def& d, const V4<double>& x) { d.pose.quat = x; });
}

// A number among the physical parameters of a definition.
template <class Def, class Params>
void bind_param(py::class_<Def>& type, const char* name, double Params::* member) {
  type.def_property(
      name, [member](const Def& d) { return d.params.*member; }, [member](Def& d, double x) { d.params.*member = x; });
}

template <class Def>
void bind_contact_params(py::class_<Def>& type) {
  using P = ContactParams<double>;
  bind_param(type, "kn", &P::kn);
  bind_param(type, "kt", &P::kt);
  bind_param(type, "mu", &P::mu);
  bind_param(type, "kd", &P::kd);
  bind_param(type, "ks", &P::ks);
}

template <class Def>
void bind_joint_params(py::class_<Def>& type) {
  using P = JointParams<double>;
  bind_param(type, "damping", &P::damping);
  bind_param(type, "armature", &P::armature);
  bind_param(type, "stiffness", &P::stiffness);
  bind_param(type, "springref", &P::springref);
  bind_param(type, "lower", &P::lower);
  bind_param(type, "upper", &P::upper);
  bind_param(type, "limit_stiffness", &P::limit_stiffness);
  bind_param(type, "limit_damping", &P::limit_damping);
  bind_param(type, "frictionloss", &P::frictionloss);
}

template <class Vectors>
std::optional<py::array> optional_array(const std::optional<Vectors>& vectors) {
  if (!vectors) return std::nullopt;
  return array_of(*vectors);
}

void bind_body(py::module_& module) {
  py::class_<BodyDef> type(module, "BodyDef");
  type.def(py::init([](const std::string& name, int parent, const V3<double>& pos, const V4<double>& quat, double mass,
                       const V3<double>& com, const V6<double>& inertia, double gravcomp,
                       const V3<double>& gravcomp_pos) {
             return BodyDef{name, parent, {pos, quat}, mass, com, inertia, {gravcomp, gravcomp_pos}};
           }),
           py::kw_only(), py::arg("name"), py::arg("parent") = world, py::arg("pos") = origin,
           py::arg("quat") = identity, py::arg("mass"), py::arg("com") = origin, py::arg("inertia"),
           py::arg("gravcomp") = 0., py::arg("gravcomp_pos") = origin)
      .def_readwrite("name", &BodyDef::name)
      .def_readwrite("parent", &BodyDef::parent)
      .def_readwrite("mass", &BodyDef::mass)
      .def_readwrite("com", &BodyDef::com)
      .def_readwrite("inertia", &BodyDef::inertia)
      .def_property(
          "gravcomp", [](const BodyDef& d) { return d.compensation.factor; },
          [](BodyDef& d, double x) { d.compensation.factor = x; })
      .def_property(
          "gravcomp_pos", [](const BodyDef& d) { return d.compensation.pos; },
          [](BodyDef& d, const V3<double>& x) { d.compensation.pos = x; });
  bind_pose(type);
}

void bind_joint(py::module_& module) {
  py::class_<JointDef> type(module, "JointDef");
  type.def(py::init([](const std::string& name, int body, const std::string& kind, const V3<double>& pos,
                       const V3<double>& axis, double ref, double damping, double armature, double stiffness,
                       double springref, double lower, double upper, double limit_stiffness, double limit_damping,
                       double frictionloss, bool prescribed) {
             const JointParams<double> params{damping, armature,        stiffness,     springref,   lower,
                                              upper,   limit_stiffness, limit_damping, frictionloss};
             return JointDef{name, body, kind, pos, axis, params, ref, prescribed};
           }),
           py::kw_only(), py::arg("name"), py::arg("body"), py::arg("type"), py::arg("pos") = origin,
           py::arg("axis") = V3<double>(0, 0, 1), py::arg("ref") = 0., py::arg("damping") = 0.,
           py::arg("armature") = 0., py::arg("stiffness") = 0., py::arg("springref") = 0.,
           py::arg("lower") = -unlimited, py::arg("upper") = unlimited, py::arg("limit_stiffness") = 0.,
           py::arg("limit_damping") = 0., py::arg("frictionloss") = 0., py::arg("prescribed") = false)
      .def_readwrite("name", &JointDef::name)
      .def_readwrite("body", &JointDef::body)
      .def_readwrite("type", &JointDef::type)
      .def_readwrite("pos", &JointDef::pos)
      .def_readwrite("axis", &JointDef::axis)
      .def_readwrite("ref", &JointDef::ref)
      .def_readwrite("prescribed", &JointDef::prescribed);
  bind_joint_params(type);
}

std::shared_ptr<DistanceGrid> distance_grid(const V3<double>& grid_origin, double spacing,
                                            const Array<float>& coefficients) {
  if (coefficients.ndim() != 3) throw std::invalid_argument("coefficients must have shape (x, y, z)");
  std::array<int, 3> cells;
  for (int a = 0; a < 3; ++a) cells[a] = static_cast<int>(coefficients.shape(a)) - 3;
  const float* data = coefficients.data();
  return std::make_shared<DistanceGrid>(cells, grid_origin, spacing,
                                        std::vector<float>(data, data + coefficients.size()));
}

void bind_shape(py::module_& module) {
  py::class_<DistanceGrid, std::shared_ptr<DistanceGrid>>(module, "DistanceGrid")
      .def(py::init(&distance_grid), py::kw_only(), py::arg("origin"), py::arg("spacing"), py::arg("coefficients"))
      .def_readonly("origin", &DistanceGrid::origin)
      .def_readonly("spacing", &DistanceGrid::spacing)
      .def_property_readonly("coefficients", [](const DistanceGrid& g) {
        return py::array_t<float>(Dimensions{g.cells[0] + 3, g.cells[1] + 3, g.cells[2] + 3}, g.coefficients.data());
      });
  py::class_<ShapeDef> type(module, "ShapeDef");
  type.def(py::init([](const std::string& name, int body, const std::string& kind, const V3<double>& pos,
                       const V4<double>& quat, const V3<double>& size, double rounding,
                       const std::shared_ptr<DistanceGrid>& grid) {
             return ShapeDef{name, body, kind, {pos, quat}, size, rounding, grid};
           }),
           py::kw_only(), py::arg("name"), py::arg("body") = world, py::arg("kind"), py::arg("pos") = origin,
           py::arg("quat") = identity, py::arg("size") = origin, py::arg("rounding") = 0., py::arg("grid") = py::none())
      .def_readwrite("name", &ShapeDef::name)
      .def_readwrite("body", &ShapeDef::body)
      .def_readwrite("kind", &ShapeDef::kind)
      .def_readwrite("size", &ShapeDef::size)
      .def_readwrite("rounding", &ShapeDef::rounding)
      .def_property(
          "grid", [](const ShapeDef& d) { return std::const_pointer_cast<DistanceGrid>(d.grid); },
          [](ShapeDef& d, const std::shared_ptr<DistanceGrid>& grid) { d.grid = grid; });
  bind_pose(type);
}

void bind_points(py::module_& module) {
  py::class_<PointsDef> type(module, "PointsDef");
  type.def(py::init([](const std::string& name, int body, const Points& points, const std::optional<Weights>& weights,
                       double radius, const V3<double>& pos, const V4<double>& quat,
                       const std::optional<Points>& areas) {
             PointsDef def{name, body, points_of(points, "points"), weights, radius, {pos, quat}, {}};
             if (areas) def.areas = points_of(*areas, "areas");
             return def;
           }),
           py::kw_only(), py::arg("name"), py::arg("body") = world, py::arg("points"), py::arg("weights") = py::none(),
           py::arg("radius") = 0., py::arg("pos") = origin, py::arg("quat") = identity, py::arg("areas") = py::none())
      .def_readwrite("name", &PointsDef::name)
      .def_readwrite("body", &PointsDef::body)
      .def_property(
          "points", [](const PointsDef& d) { return array_of(d.points); },
          [](PointsDef& d, const Points& points) { d.points = points_of(points, "points"); })
      .def_readwrite("weights", &PointsDef::weights)
      .def_readwrite("radius", &PointsDef::radius)
      .def_property(
          "areas", [](const PointsDef& d) { return optional_array(d.areas); },
          [](PointsDef& d, const std::optional<Points>& areas) {
            d.areas.reset();
            if (areas) d.areas = points_of(*areas, "areas");
          });
  bind_pose(type);
}

void bind_contact(py::module_& module) {
  py::class_<ContactDef> type(module, "ContactDef");
  type.def(py::init([](const std::string& name, int points, int shape, const std::string& law,
                       const std::string& damping, double kn, double kt, double mu, double kd,
                       double ks) { return ContactDef{name, points, shape, law, damping, {kn, kt, mu, kd, ks}}; }),
           py::kw_only(), py::arg("name"), py::arg("points"), py::arg("shape"), py::arg("law") = "viscous",
           py::arg("damping") = "hunt-crossley", py::arg("kn"), py::arg("kt"), py::arg("mu"), py::arg("kd"),
           py::arg("ks") = 0.)
      .def_readwrite("name", &ContactDef::name)
      .def_readwrite("points", &ContactDef::points)
      .def_readwrite("shape", &ContactDef::shape)
      .def_readwrite("law", &ContactDef::law)
      .def_readwrite("damping", &ContactDef::damping);
  bind_contact_params(type);
}

void bind_pad(py::module_& module) {
  py::class_<PadDef> type(module, "PadDef");
  type.def(
          py::init([](const std::string& name, int body, const Points& positions, const std::optional<Points>& axes,
                      const std::vector<int>& shapes, const std::string& law, double kn, double kt, double mu,
                      double kd, double ks, const std::optional<Weights>& weights, const V3<double>& pos,
                      const V4<double>& quat, bool collides) {
            PadDef def{
                name,        body,    points_of(positions, "positions"), {}, shapes, law, {kn, kt, mu, kd, ks}, weights,
                {pos, quat}, collides};
            if (axes) def.axes = matrices_of(*axes, "axes");
            return def;
          }),
          py::kw_only(), py::arg("name"), py::arg("body") = world, py::arg("positions"), py::arg("axes") = py::none(),
          py::arg("shapes"), py::arg("law") = "viscous", py::arg("kn"), py::arg("kt"), py::arg("mu"), py::arg("kd"),
          py::arg("ks") = 0., py::arg("weights") = py::none(), py::arg("pos") = origin, py::arg("quat") = identity,
          py::arg("collides") = false)
      .def_readwrite("name", &PadDef::name)
      .def_readwrite("body", &PadDef::body)
      .def_property(
          "positions", [](const PadDef& d) { return array_of(d.positions); },
          [](PadDef& d, const Points& positions) { d.positions = points_of(positions, "positions"); })
      .def_property(
          "axes", [](const PadDef& d) { return optional_array(d.axes); },
          [](PadDef& d, const std::optional<Points>& axes) {
            d.axes.reset();
            if (axes) d.axes = matrices_of(*axes, "axes");
          })
      .def_readwrite("shapes", &PadDef::shapes)
      .def_readwrite("law", &PadDef::law)
      .def_readwrite("weights", &PadDef::weights)
      .def_readwrite("collides", &PadDef::collides);
  bind_pose(type);
  bind_contact_params(type);
}

void bind_tendon(py::module_& module) {
  py::class_<TendonDef> type(module, "TendonDef");
  type.def(py::init([](const std::string& name, const std::vector<int>& joints, const std::vector<double>& coefficients,
                       double damping, double armature, double stiffness, double springref, double lower, double upper,
                       double limit_stiffness, double limit_damping, double frictionloss) {
             const JointParams<double> params{damping, armature,        stiffness,     springref,   lower,
                                              upper,   limit_stiffness, limit_damping, frictionloss};
             return TendonDef{name, joints, coefficients, params};
           }),
           py::kw_only(), py::arg("name"), py::arg("joints"), py::arg("coefficients"), py::arg("damping") = 0.,
           py::arg("armature") = 0., py::arg("stiffness") = 0., py::arg("springref") = 0.,
           py::arg("lower") = -unlimited, py::arg("upper") = unlimited, py::arg("limit_stiffness") = 0.,
           py::arg("limit_damping") = 0., py::arg("frictionloss") = 0.)
      .def_readwrite("name", &TendonDef::name)
      .def_readwrite("joints", &TendonDef::joints)
      .def_readwrite("coefficients", &TendonDef::coefficients);
  bind_joint_params(type);
}

void bind_coupling(py::module_& module) {
  py::class_<CouplingDef> type(module, "CouplingDef");
  type.def(py::init([](const std::string& name, int joint, int leader, const std::vector<double>& coefficients,
                       double stiffness, double damping) {
             return CouplingDef{name, joint, leader, coefficients, {stiffness, damping}};
           }),
           py::kw_only(), py::arg("name"), py::arg("joint"), py::arg("leader") = -1, py::arg("coefficients"),
           py::arg("stiffness") = 0., py::arg("damping") = 0.)
      .def_readwrite("name", &CouplingDef::name)
      .def_readwrite("joint", &CouplingDef::joint)
      .def_readwrite("leader", &CouplingDef::leader)
      .def_readwrite("coefficients", &CouplingDef::coefficients);
  bind_param(type, "stiffness", &SpringParams<double>::stiffness);
  bind_param(type, "damping", &SpringParams<double>::damping);
}

void bind_loop_closure(py::module_& module) {
  using P = LoopClosureParams<double>;
  py::class_<LoopClosureDef> type(module, "LoopClosureDef");
  type.def(py::init([](const std::string& name, int first, int second, const V3<double>& first_pos,
                       const V3<double>& second_pos, bool weld, const V4<double>& quat, double stiffness,
                       double damping, double turn_stiffness, double turn_damping) {
             const P params{stiffness, damping, turn_stiffness, turn_damping, first_pos, second_pos};
             return LoopClosureDef{name, first, second, weld, quat, params};
           }),
           py::kw_only(), py::arg("name"), py::arg("first") = world, py::arg("second") = world,
           py::arg("first_pos") = origin, py::arg("second_pos") = origin, py::arg("weld") = false,
           py::arg("quat") = identity, py::arg("stiffness"), py::arg("damping") = 0., py::arg("turn_stiffness") = 0.,
           py::arg("turn_damping") = 0.)
      .def_readwrite("name", &LoopClosureDef::name)
      .def_readwrite("first", &LoopClosureDef::first)
      .def_readwrite("second", &LoopClosureDef::second)
      .def_readwrite("weld", &LoopClosureDef::weld)
      .def_readwrite("quat", &LoopClosureDef::quat);
  bind_param(type, "stiffness", &P::stiffness);
  bind_param(type, "damping", &P::damping);
  bind_param(type, "turn_stiffness", &P::turn_stiffness);
  bind_param(type, "turn_damping", &P::turn_damping);
}

void bind_actuator(py::module_& module) {
  py::class_<ActuatorDef> type(module, "ActuatorDef");
  type.def(py::init([](const std::string& name, int joint, int tendon, const std::string& kind, double gear, double kp,
                       double kd, double force_lower, double force_upper, double ctrl_lower, double ctrl_upper,
                       double gain, double bias) {
             const ActuatorParams<double> params{gear,       kp,         kd,   force_lower, force_upper,
                                                 ctrl_lower, ctrl_upper, gain, bias};
             return ActuatorDef{name, joint, tendon, kind, params};
           }),
           py::kw_only(), py::arg("name"), py::arg("joint") = -1, py::arg("tendon") = -1, py::arg("kind"),
           py::arg("gear") = 1., py::arg("kp") = 0., py::arg("kd") = 0., py::arg("force_lower") = -unlimited,
           py::arg("force_upper") = unlimited, py::arg("ctrl_lower") = -unlimited, py::arg("ctrl_upper") = unlimited,
           py::arg("gain") = 1., py::arg("bias") = 0.)
      .def_readwrite("name", &ActuatorDef::name)
      .def_readwrite("joint", &ActuatorDef::joint)
      .def_readwrite("tendon", &ActuatorDef::tendon)
      .def_readwrite("kind", &ActuatorDef::kind);
  using P = ActuatorParams<double>;
  bind_param(type, "gear", &P::gear);
  bind_param(type, "kp", &P::kp);
  bind_param(type, "kd", &P::kd);
  bind_param(type, "force_lower", &P::force_lower);
  bind_param(type, "force_upper", &P::force_upper);
  bind_param(type, "ctrl_lower", &P::ctrl_lower);
  bind_param(type, "ctrl_upper", &P::ctrl_upper);
  bind_param(type, "gain", &P::gain);
  bind_param(type, "bias", &P::bias);
}

}  // namespace

void bind_definitions(py::module_& module) {
  bind_body(module);
  bind_joint(module);
  bind_shape(module);
  bind_points(module);
  bind_contact(module);
  bind_pad(module);
  bind_tendon(module);
  bind_coupling(module);
  bind_loop_closure(module);
  bind_actuator(module);
}

}  // namespace gelflow
