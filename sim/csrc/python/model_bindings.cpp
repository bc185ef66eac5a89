// ModelSpec and Model.
#include <algorithm>

#include "geometry/shapes.hpp"
#include "model/model_spec.hpp"
#include "python/arrays.hpp"
#include "python/bindings.hpp"

namespace gelflow {

namespace {

template <class Item>
std::vector<std::string> names(const std::vector<Item>& items) {
  std::vector<std::string> result;
  for (const auto& item : items) result.push_back(item.name);
  return result;
}

template <class Item, class Field>
std::vector<int> column(const std::vector<Item>& items, Field Item::* field) {
  std::vector<int> result;
  for (const auto& item : items) result.push_back(item.*field);
  return result;
}

// Signed distance (n), normal (n, 3) and Hessian (n, 3, 3) at points of a shape's frame, by the SIMD packs of the
// simulator.
py::tuple distance_at(const Model& m, const std::string& name, const Array<double>& points) {
  using P = Pack<double>;
  constexpr int width = pack_width<double>;
  const auto shape = std::find_if(m.shapes.begin(), m.shapes.end(), [&](const Shape& s) { return s.name == name; });
  if (shape == m.shapes.end()) throw std::invalid_argument("no shape '" + name + "'");
  const std::vector<V3<double>> x = points_of(points, "points");
  const auto n = static_cast<py::ssize_t>(x.size());
  py::array_t<double> d(n), normal({n, py::ssize_t{3}}), hessian({n, py::ssize_t{3}, py::ssize_t{3}});
  double *to_d = d.mutable_data(), *to_normal = normal.mutable_data(), *to_hessian = hessian.mutable_data();
  for (py::ssize_t begin = 0; begin < n; begin += width) {
    Vec3<P> at;
    for (int k = 0; k < width; ++k) set_lane3<double>(at, k, x[std::min(begin + k, n - 1)]);
    Distance<P> found;
    distance<true>(shape->kind, m.param_defaults.data() + shape->size.offset, shape->grid.get(), at, found);
    found.hessian = found.form == HessianForm::zero ? zero33<P>() : found.hessian_matrix();
    for (int k = 0; k < width && begin + k < n; ++k) {
      const py::ssize_t i = begin + k;
      to_d[i] = lane(found.d, k);
      for (int a = 0; a < 3; ++a) {
        to_normal[3 * i + a] = lane(found.n[a], k);
        for (int b = 0; b < 3; ++b) to_hessian[9 * i + 3 * a + b] = lane(found.hessian.row[a][b], k);
      }
    }
  }
  return py::make_tuple(d, normal, hessian);
}

template <class Value>
void bind_option(py::class_<ModelSpec>& type, const char* name, Value SolverOptions::* option) {
  type.def_property(
      name, [option](const ModelSpec& s) { return s.options.*option; },
      [option](ModelSpec& s, Value value) { s.options.*option = value; });
}

template <class Def>
void bind_list(py::class_<ModelSpec>& type, const char* name, std::vector<Def> Definitions::* list) {
  type.def_property_readonly(name, [list](const ModelSpec& s) { return s.definitions().*list; });
}

void bind_spec(py::module_& module) {
  py::class_<ModelSpec> type(module, "ModelSpec");
  type.def(py::init<>())
      .def_readwrite("gravity", &ModelSpec::gravity)
      .def_readwrite("integrator", &ModelSpec::integrator)
      .def("add_body", &ModelSpec::add_body, py::arg("definition"))
      .def("add_joint", &ModelSpec::add_joint, py::arg("definition"))
      .def("add_shape", &ModelSpec::add_shape, py::arg("definition"))
      .def("add_points", &ModelSpec::add_points, py::arg("definition"))
      .def("add_contact", &ModelSpec::add_contact, py::arg("definition"))
      .def("add_pad", &ModelSpec::add_pad, py::arg("definition"))
      .def("add_tendon", &ModelSpec::add_tendon, py::arg("definition"))
      .def("add_coupling", &ModelSpec::add_coupling, py::arg("definition"))
      .def("add_loop_closure", &ModelSpec::add_loop_closure, py::arg("definition"))
      .def("add_actuator", &ModelSpec::add_actuator, py::arg("definition"));
  bind_option(type, "step", &SolverOptions::step);
  bind_option(type, "tolerance", &SolverOptions::tolerance);
  bind_option(type, "max_iterations", &SolverOptions::max_iterations);
  bind_option(type, "max_step_iterations", &SolverOptions::max_step_iterations);
  bind_option(type, "max_halvings", &SolverOptions::max_halvings);
  bind_option(type, "polish", &SolverOptions::polish);
  bind_list(type, "bodies", &Definitions::bodies);
  bind_list(type, "joints", &Definitions::joints);
  bind_list(type, "shapes", &Definitions::shapes);
  bind_list(type, "points", &Definitions::points);
  bind_list(type, "contacts", &Definitions::contacts);
  bind_list(type, "pads", &Definitions::pads);
  bind_list(type, "tendons", &Definitions::tendons);
  bind_list(type, "couplings", &Definitions::couplings);
  bind_list(type, "loop_closures", &Definitions::loop_closures);
  bind_list(type, "actuators", &Definitions::actuators);
}

}  // namespace

void bind_model(py::module_& module) {
  bind_spec(module);
  py::class_<Model, std::shared_ptr<Model>>(module, "Model")
      .def(py::init([](const ModelSpec& spec) { return std::make_shared<Model>(spec.build()); }), py::arg("spec"))
      .def_readonly("nq", &Model::nq)
      .def_readonly("nv", &Model::nv)
      .def_property_readonly("nu", [](const Model& m) { return m.actuators.size(); })
      .def_readonly("na", &Model::na)
      .def_readonly("nh", &Model::nh)
      .def_readonly("num_markers", &Model::num_markers)
      .def_property_readonly("step", [](const Model& m) { return m.step; })
      .def_readonly("q0", &Model::q0)
      .def_readonly("param_names", &Model::param_names)
      .def_readonly("param_defaults", &Model::param_defaults)
      .def_property_readonly("body_names", [](const Model& m) { return names(m.bodies); })
      .def_property_readonly("joint_names", [](const Model& m) { return names(m.joints); })
      .def_property_readonly("contact_names", [](const Model& m) { return names(m.contacts); })
      .def_property_readonly("pad_names", [](const Model& m) { return names(m.pads); })
      .def_property_readonly("tendon_names", [](const Model& m) { return names(m.tendons); })
      .def_property_readonly("loop_closure_names", [](const Model& m) { return names(m.loop_closures); })
      .def_property_readonly("actuator_names", [](const Model& m) { return names(m.actuators); })
      .def_property_readonly("joint_q", [](const Model& m) { return column(m.joints, &Joint::q); })
      .def_property_readonly("joint_v", [](const Model& m) { return column(m.joints, &Joint::v); })
      .def_property_readonly("contact_anchors", [](const Model& m) { return column(m.contacts, &Contact::anchor); })
      .def_property_readonly("pad_markers",
                             [](const Model& m) {
                               std::vector<std::pair<int, int>> ranges;
                               for (const Pad& pad : m.pads) ranges.emplace_back(pad.first_marker, pad.cloud.size());
                               return ranges;
                             })
      .def("distance", &distance_at, py::arg("shape"), py::arg("points"),
           "Distance (n), normal (n, 3) and Hessian (n, 3, 3) of a shape at points (n, 3) of its frame.");
}

}  // namespace gelflow
