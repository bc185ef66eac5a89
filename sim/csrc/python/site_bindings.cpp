// Sites and their poses.
#include "dynamics/site_poses.hpp"
#include "dynamics/state_checks.hpp"
#include "python/arrays.hpp"
#include "python/bindings.hpp"

namespace gelflow {

namespace {

using Sites = std::vector<SiteDef>;

// The rows of a call, after checks of its arrays and their values.
SiteRows checked(const Model& m, const Sites& sites, const Array<double>& params, const Array<double>& q) {
  const py::ssize_t rows = q.ndim() == 2 ? q.shape(0) : 0, n = params.ndim() == 2 ? params.shape(0) : 0;
  check_shape(q, {rows, m.nq}, "q");
  check_shape(params, {n, static_cast<py::ssize_t>(m.param_names.size())}, "params");
  if (n == 0 || rows % n != 0) throw std::invalid_argument("q must have a multiple of the rows of params");
  for (const SiteDef& site : sites) {
    if (site.body < world || site.body >= static_cast<int>(m.bodies.size())) {
      throw std::invalid_argument("site '" + site.name + "' refers to body " + std::to_string(site.body));
    }
  }
  check_finite(q.data(), "q", static_cast<int>(rows), m.nq, nullptr);
  check_quaternions(m, q.data(), static_cast<int>(rows), nullptr);
  for (py::ssize_t i = 0; i < n; ++i) {
    const std::string wrong = wrong_parameter(m, params.data(i, 0));
    if (!wrong.empty()) throw std::invalid_argument("environment " + std::to_string(i) + ": " + wrong);
  }
  return {q.data(), params.data(), static_cast<int>(rows), static_cast<int>(n)};
}

}  // namespace

void bind_sites(py::module_& module) {
  py::class_<SiteDef>(module, "SiteDef")
      .def(py::init([](const std::string& name, int body, const V3<double>& pos, const V4<double>& quat) {
             return SiteDef{name, body, {pos, quat}};
           }),
           py::kw_only(), py::arg("name"), py::arg("body"), py::arg("pos"), py::arg("quat"))
      .def_readonly("name", &SiteDef::name)
      .def_readonly("body", &SiteDef::body)
      .def_property_readonly("pos", [](const SiteDef& site) { return site.pose.pos; })
      .def_property_readonly("quat", [](const SiteDef& site) { return site.pose.quat; });
  module.def(
      "site_poses",
      [](const Model& m, const Sites& sites, const Array<double>& params, const Array<double>& q) {
        const SiteRows at = checked(m, sites, params, q);
        py::array_t<double> poses(Dimensions{at.rows, static_cast<py::ssize_t>(sites.size()), 7});
        site_poses(m, sites, at, poses.mutable_data());
        return poses;
      },
      py::arg("model"), py::arg("sites"), py::arg("params"), py::arg("q"),
      "Poses (rows, sites, 7) at positions q (rows, nq) of N environments in turn, with parameters (N, parameters).");
  module.def(
      "site_poses_vjp",
      [](const Model& m, const Sites& sites, const Array<double>& params, const Array<double>& q,
         const Array<double>& grad_poses) {
        const SiteRows at = checked(m, sites, params, q);
        check_shape(grad_poses, {at.rows, static_cast<py::ssize_t>(sites.size()), 7}, "grad_poses");
        py::array_t<double> grad_q(Dimensions{at.rows, m.nq});
        std::fill_n(grad_q.mutable_data(), grad_q.size(), 0.0);
        site_poses_vjp(m, sites, at, grad_poses.data(), grad_q.mutable_data());
        return grad_q;
      },
      py::arg("model"), py::arg("sites"), py::arg("params"), py::arg("q"), py::arg("grad_poses"),
      "Gradient (rows, nq) from the gradient with respect to the poses (rows, sites, 7).");
}

}  // namespace gelflow
