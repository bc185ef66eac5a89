// Directional derivatives of a rollout.
#include "batch/directional.hpp"

#include "python/arrays.hpp"
#include "python/bindings.hpp"

namespace gelflow {

namespace {

struct InputArrays {
  Array<double> params, q, v, anchors, history, u;
  std::optional<Array<std::uint8_t>> anchored;
};

RolloutInput checked(const Model& m, const InputArrays& a, int q, py::ssize_t steps) {
  const auto np = static_cast<py::ssize_t>(m.param_names.size()), nu = static_cast<py::ssize_t>(m.actuators.size());
  return {readable<double>(a.params, {np}, "params"),
          readable<double>(a.q, {q}, "q"),
          readable<double>(a.v, {m.nv}, "v"),
          readable<double>(a.anchors, {m.na, 3}, "anchors"),
          readable<double>(a.history, {m.nh}, "history"),
          readable<double>(a.u, {steps, nu}, "u"),
          a.anchored ? readable<std::uint8_t>(*a.anchored, {m.na}, "anchored") : nullptr};
}

DirectionalRollout run(const Model& m, const InputArrays& start, const std::vector<InputArrays>& directions) {
  if (!start.anchored) throw std::invalid_argument("start needs anchored");
  if (directions.empty()) throw std::invalid_argument("directions must not be empty");
  const py::ssize_t steps = start.u.shape(0);
  std::vector<RolloutInput> inputs;
  for (const InputArrays& direction : directions) inputs.push_back(checked(m, direction, m.nv, steps));
  return directional_rollout(m, static_cast<int>(steps), checked(m, start, m.nq, steps), inputs);
}

void bind_end(py::module_& module) {
  py::class_<RolloutEnd> type(module, "RolloutEnd");
  const auto array = [&](const char* name, std::vector<double> RolloutEnd::* field) {
    type.def_property_readonly(name, [field](const RolloutEnd& end) {
      const std::vector<double>& values = end.*field;
      return py::array_t<double>(static_cast<py::ssize_t>(values.size()), values.data());
    });
  };
  array("q", &RolloutEnd::q);
  array("v", &RolloutEnd::v);
  array("anchors", &RolloutEnd::anchors);
  array("tactile", &RolloutEnd::tactile);
}

}  // namespace

void bind_directional(py::module_& module) {
  using A = Array<double>;
  py::class_<InputArrays>(module, "RolloutInput")
      .def(py::init([](const A& params, const A& q, const A& v, const A& anchors, const A& history, const A& u,
                       const std::optional<Array<std::uint8_t>>& anchored) {
             return InputArrays{params, q, v, anchors, history, u, anchored};
           }),
           py::kw_only(), py::arg("params"), py::arg("q"), py::arg("v"), py::arg("anchors"), py::arg("history"),
           py::arg("u"), py::arg("anchored") = py::none());
  bind_end(module);
  py::class_<DirectionalRollout>(module, "DirectionalRollout")
      .def_readonly("end", &DirectionalRollout::end)
      .def_readonly("derivatives", &DirectionalRollout::derivatives)
      .def_property_readonly("anchored",
                             [](const DirectionalRollout& r) {
                               return py::array_t<std::uint8_t>(static_cast<py::ssize_t>(r.anchored.size()),
                                                                r.anchored.data());
                             })
      .def_readonly("status", &DirectionalRollout::status);
  module.def("directional_rollout", &run, py::arg("model"), py::arg("start"), py::arg("directions"),
             "Derivatives of a rollout of one environment along directions, by dual numbers.");
}

}  // namespace gelflow
