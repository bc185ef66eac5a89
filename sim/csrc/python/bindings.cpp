// The Python module gelflow.sim._core: thin, no logic of its own beyond checking shapes.
#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include "batch/batch.hpp"
#include "python/shape_bindings.hpp"

namespace py = pybind11;
using namespace gelflow;

namespace {

std::string shape_text(const std::vector<py::ssize_t>& shape) {
  std::string text = "(";
  for (std::size_t i = 0; i < shape.size(); ++i) text += (i ? ", " : "") + std::to_string(shape[i]);
  return text + (shape.size() == 1 ? ",)" : ")");
}

template <class T>
void check_shape(const Array<T>& array, const std::vector<py::ssize_t>& shape, const char* name) {
  const std::vector<py::ssize_t> got(array.shape(), array.shape() + array.ndim());
  if (got != shape) {
    throw std::invalid_argument(std::string(name) + " must have shape " + shape_text(shape) + ", got " +
                                shape_text(got));
  }
}

// Arrays that are written must be the caller's own memory: no silent copy.
template <class T>
T* writable(py::array& array, const std::vector<py::ssize_t>& shape, const char* name) {
  if (!py::isinstance<Array<T>>(array)) {
    throw std::invalid_argument(std::string(name) + " must be a C-contiguous array of the batch's precision");
  }
  auto typed = py::reinterpret_borrow<Array<T>>(array);
  check_shape<T>(typed, shape, name);
  return typed.mutable_data();
}

// Controls (N, nu), or (nu,) for all environments alike.
template <class T>
Controls<T> controls_of(const Batch<T>& b, const Array<T>& u) {
  const auto nu = static_cast<py::ssize_t>(b.model->actuators.size());
  const bool alike = u.ndim() == 1 && u.shape(0) == nu;
  if (!alike && !(u.ndim() == 2 && u.shape(0) == b.n && u.shape(1) == nu)) {
    throw std::invalid_argument("u must have shape " + shape_text({b.n, nu}) + " or (" + std::to_string(nu) +
                                ",), got " + shape_text({u.shape(), u.shape() + u.ndim()}));
  }
  return {u.data(), alike};
}

// A view of memory that `owner` keeps alive.
template <class T>
py::array view(T* data, const std::vector<py::ssize_t>& shape, const py::object& owner) {
  return py::array_t<T>(shape, data, owner);
}

template <class T>
Rollout<T> rollout_of(const Batch<T>& b, const Array<T>& u, py::array& q, py::array& v, py::array& anchors,
                      py::array& anchored, py::array& history, py::array& halvings, py::array& status,
                      const Array<int>& read_after, py::array& tactile) {
  if (u.ndim() != 3) throw std::invalid_argument("u must have shape (steps, environments, actuators)");
  const Model& m = *b.model;
  const py::ssize_t steps = u.shape(0), n = b.n, reads = read_after.size(), nu = m.actuators.size();
  check_shape<T>(u, {steps, n, nu}, "u");
  for (py::ssize_t i = 0; i < reads; ++i) {
    const int at = read_after.at(i);
    if (at < 0 || at > steps || (i > 0 && at <= read_after.at(i - 1))) {
      throw std::invalid_argument("read_after must increase and lie between 0 and the number of steps");
    }
  }
  return {static_cast<int>(steps),
          static_cast<int>(reads),
          u.data(),
          writable<T>(q, {steps + 1, n, m.nq}, "q"),
          writable<T>(v, {steps + 1, n, m.nv}, "v"),
          writable<T>(anchors, {steps + 1, n, m.na, 3}, "anchors"),
          writable<T>(history, {steps + 1, n, m.nh}, "history"),
          writable<std::uint8_t>(anchored, {steps + 1, n, m.na}, "anchored"),
          writable<std::int8_t>(halvings, {steps, n}, "halvings"),
          writable<std::int32_t>(status, {n}, "status"),
          read_after.data(),
          writable<T>(tactile, {reads, n, m.markers, 3}, "tactile")};
}

template <class T>
void bind_batch(py::module_& module, const char* name) {
  using B = Batch<T>;
  const auto self_view = [](auto member, auto shape) {
    return [member, shape](py::object self) {
      B& b = self.cast<B&>();
      return view((b.*member).data(), shape(b), self);
    };
  };
  const auto per_env = [](const B& b) { return std::vector<py::ssize_t>{b.n}; };
  py::class_<B>(module, name)
      .def(py::init<std::shared_ptr<const Model>, int, int>(), py::arg("model"), py::arg("environments"),
           py::arg("threads"))
      .def_readonly("environments", &B::n)
      .def_property_readonly("threads", &B::threads)
      .def_property_readonly("q",
                             self_view(&B::q, [](const B& b) { return std::vector<py::ssize_t>{b.n, b.model->nq}; }))
      .def_property_readonly("v",
                             self_view(&B::v, [](const B& b) { return std::vector<py::ssize_t>{b.n, b.model->nv}; }))
      .def_property_readonly("params", self_view(&B::params,
                                                 [](const B& b) {
                                                   const auto np =
                                                       static_cast<py::ssize_t>(b.model->param_names.size());
                                                   return std::vector<py::ssize_t>{b.n, np};
                                                 }))
      .def_property_readonly("anchors",
                             [](py::object self) {
                               B& b = self.cast<B&>();
                               return view(reinterpret_cast<T*>(b.anchors.data()), {b.n, b.model->na, 3}, self);
                             })
      .def_property_readonly(
          "anchored", self_view(&B::anchored, [](const B& b) { return std::vector<py::ssize_t>{b.n, b.model->na}; }))
      .def_property_readonly(
          "history", self_view(&B::history, [](const B& b) { return std::vector<py::ssize_t>{b.n, b.model->nh}; }))
      .def_property_readonly("status", self_view(&B::status, per_env))
      .def_property_readonly("iterations", self_view(&B::iterations, per_env))
      .def_property_readonly("halved", self_view(&B::halved, per_env))
      .def(
          "reset",
          [](B& b, const std::optional<Array<std::uint8_t>>& which) {
            if (which) check_shape<std::uint8_t>(*which, {b.n}, "which");
            b.reset(which ? which->data() : nullptr);
          },
          py::arg("which") = py::none())
      .def(
          "step",
          [](B& b, const Array<T>& u, int steps) {
            const Controls<T> controls = controls_of<T>(b, u);
            const py::gil_scoped_release release;
            b.step(controls, steps);
          },
          py::arg("u"), py::arg("steps") = 1)
      .def("error_estimate",
           [](B& b, const Array<T>& u) {
             const Controls<T> controls = controls_of<T>(b, u);
             py::array_t<T> out({static_cast<py::ssize_t>(b.n), static_cast<py::ssize_t>(b.model->nv)});
             py::array_t<std::int32_t> status(static_cast<py::ssize_t>(b.n));
             b.error_estimate(controls, out.mutable_data(), status.mutable_data());
             return py::make_tuple(out, status);
           })
      .def("tactile",
           [](B& b, py::array out) {
             T* data = writable<T>(out, {b.n, b.model->markers, 3}, "out");
             const py::gil_scoped_release release;
             b.tactile(data);
           })
      .def(
          "tactile", [](B& b) { b.tactile(); }, py::call_guard<py::gil_scoped_release>())
      .def_property_readonly("readings",  // what `tactile()` wrote
                             [](py::object self) {
                               B& b = self.cast<B&>();
                               py::array own = view(b.readings.data(), {b.n, b.model->markers, 3}, self);
                               own.attr("flags").attr("writeable") = false;
                               return own;
                             })
      .def("wrenches",
           [](B& b, py::array out) {
             b.wrenches(writable<T>(out, {b.n, static_cast<py::ssize_t>(b.model->contacts.size()), 6}, "out"));
           })
      .def("contact_forces", [](B& b, py::array out) { b.contact_forces(writable<T>(out, {b.n, b.model->nv}, "out")); })
      .def("poses",
           [](B& b, py::array out) {
             b.poses(writable<T>(out, {b.n, static_cast<py::ssize_t>(b.model->bodies.size()), 7}, "out"));
           })
      .def("mass_matrix",
           [](B& b, py::array out) { b.mass_matrix(writable<T>(out, {b.n, b.model->nv, b.model->nv}, "out")); })
      .def("bias", [](B& b, py::array out) { b.bias(writable<T>(out, {b.n, b.model->nv}, "out")); })
      .def(
          "rollout",
          [](B& b, const Array<T>& u, py::array q, py::array v, py::array anchors, py::array anchored,
             py::array history, py::array halvings, py::array status, const Array<int>& read_after, py::array tactile) {
            const auto r = rollout_of<T>(b, u, q, v, anchors, anchored, history, halvings, status, read_after, tactile);
            const py::gil_scoped_release release;
            b.rollout(r);
          })
      .def(
          "branches",
          [](B& b, const Array<T>& u, py::array q, py::array v, py::array anchors, py::array anchored,
             py::array history, py::array halvings, py::array status, const Array<int>& read_after, py::array tactile) {
            const auto r = rollout_of<T>(b, u, q, v, anchors, anchored, history, halvings, status, read_after, tactile);
            py::array_t<std::uint64_t> out({static_cast<py::ssize_t>(r.steps), static_cast<py::ssize_t>(b.n)});
            b.branches(r, out.mutable_data());
            return out;
          })
      .def("rollout_transposed", [](B& b, const Array<T>& u, py::array q, py::array v, py::array anchors,
                                    py::array anchored, py::array history, py::array halvings, py::array status,
                                    const Array<int>& read_after, py::array tactile, const Array<T>& by_q,
                                    const Array<T>& by_v, const Array<T>& by_anchors_end,
                                    const Array<T>& by_history_end, const Array<T>& by_tactile, bool params) {
        const auto r = rollout_of<T>(b, u, q, v, anchors, anchored, history, halvings, status, read_after, tactile);
        const Model& m = *b.model;
        const py::ssize_t n = b.n, nu = m.actuators.size();
        check_shape<T>(by_q, {r.steps + 1, n, m.nq}, "by_q");
        check_shape<T>(by_v, {r.steps + 1, n, m.nv}, "by_v");
        check_shape<T>(by_anchors_end, {n, m.na, 3}, "by_anchors_end");
        check_shape<T>(by_history_end, {n, m.nh}, "by_history_end");
        check_shape<T>(by_tactile, {r.reads, n, m.markers, 3}, "by_tactile");
        py::array_t<T> by_u({static_cast<py::ssize_t>(r.steps), n, nu}), by_q0({n, static_cast<py::ssize_t>(m.nq)}),
            by_v0({n, static_cast<py::ssize_t>(m.nv)}),
            by_anchors0({n, static_cast<py::ssize_t>(m.na), py::ssize_t{3}});
        const py::ssize_t asked = params ? static_cast<py::ssize_t>(m.param_names.size()) : 0;
        py::array_t<T> by_history0({n, static_cast<py::ssize_t>(m.nh)});
        py::array_t<double> by_params({n, asked});
        const RolloutGradient<T> g{by_q.data(),
                                   by_v.data(),
                                   by_anchors_end.data(),
                                   by_history_end.data(),
                                   by_tactile.data(),
                                   by_u.mutable_data(),
                                   by_q0.mutable_data(),
                                   by_v0.mutable_data(),
                                   by_anchors0.mutable_data(),
                                   by_history0.mutable_data(),
                                   params ? by_params.mutable_data() : nullptr};
        {
          const py::gil_scoped_release release;
          b.rollout_transposed(r, g);
        }
        return py::make_tuple(by_u, by_q0, by_v0, by_anchors0, by_history0, by_params);
      });
}

py::dict directional(const Model& m, const Array<double>& params, const Array<double>& q, const Array<double>& v,
                     const Array<double>& anchors, const Array<std::uint8_t>& anchored, const Array<double>& history,
                     const Array<double>& u, const Array<double>& dparams, const Array<double>& dq,
                     const Array<double>& dv, const Array<double>& danchors, const Array<double>& dhistory,
                     const Array<double>& du) {
  const py::ssize_t np = m.param_names.size(), nu = m.actuators.size(), steps = u.shape(0);
  check_shape<double>(params, {np}, "params");
  check_shape<double>(dparams, {np}, "dparams");
  check_shape<double>(q, {m.nq}, "q");
  check_shape<double>(dq, {m.nv}, "dq");
  check_shape<double>(v, {m.nv}, "v");
  check_shape<double>(dv, {m.nv}, "dv");
  check_shape<double>(anchors, {m.na, 3}, "anchors");
  check_shape<double>(danchors, {m.na, 3}, "danchors");
  check_shape<std::uint8_t>(anchored, {m.na}, "anchored");
  check_shape<double>(history, {m.nh}, "history");
  check_shape<double>(dhistory, {m.nh}, "dhistory");
  check_shape<double>(u, {steps, nu}, "u");
  check_shape<double>(du, {steps, nu}, "du");
  const DirectionalRollout out = directional_rollout(
      m, {params.data(), q.data(), v.data(), anchors.data(), history.data(), u.data(), anchored.data(), dparams.data(),
          dq.data(), dv.data(), danchors.data(), dhistory.data(), du.data(), static_cast<int>(steps)});
  const auto array = [](const std::vector<double>& x) { return py::array_t<double>(x.size(), x.data()); };
  return py::dict(py::arg("q") = array(out.q), py::arg("v") = array(out.v), py::arg("tactile") = array(out.tactile),
                  py::arg("anchors") = array(out.anchors), py::arg("dq") = array(out.dq), py::arg("dv") = array(out.dv),
                  py::arg("dtactile") = array(out.dtactile), py::arg("danchors") = array(out.danchors),
                  py::arg("anchored") = py::array_t<std::uint8_t>(out.anchored.size(), out.anchored.data()),
                  py::arg("status") = out.status);
}

template <class Item>
std::vector<std::string> names(const std::vector<Item>& items) {
  std::vector<std::string> result;
  for (const auto& item : items) result.push_back(item.name);
  return result;
}

}  // namespace

PYBIND11_MODULE(GELFLOW_CORE, module) {
  module.doc() = "C++ core of the simulator; use gelflow.sim.Simulator.";
  constexpr double inf = ModelSpec::inf;
  const V3<double> origin = V3<double>::Zero();
  const V4<double> upright = V4<double>::Unit(0);

  py::class_<ModelSpec>(module, "ModelSpec")
      .def(py::init<>())
      .def_readwrite("gravity", &ModelSpec::gravity)
      .def_readwrite("step", &ModelSpec::step)
      .def_readwrite("tolerance", &ModelSpec::tolerance)
      .def_readwrite("max_iterations", &ModelSpec::max_iterations)
      .def_readwrite("max_halvings", &ModelSpec::max_halvings)
      .def_readwrite("polish", &ModelSpec::polish)
      .def_readwrite("max_step_iterations", &ModelSpec::max_step_iterations)
      .def_readwrite("integrator", &ModelSpec::integrator)
      .def("add_body", &ModelSpec::add_body, py::arg("name"), py::arg("parent"), py::arg("pos"), py::arg("quat"),
           py::arg("mass"), py::arg("com"), py::arg("inertia"))
      .def("add_joint", &ModelSpec::add_joint, py::arg("name"), py::arg("body"), py::arg("type"), py::arg("pos"),
           py::arg("axis"), py::arg("damping") = 0., py::arg("armature") = 0., py::arg("stiffness") = 0.,
           py::arg("springref") = 0., py::arg("lower") = -inf, py::arg("upper") = inf, py::arg("limit_stiffness") = 0.,
           py::arg("limit_damping") = 0., py::arg("ref") = 0., py::arg("frictionloss") = 0.)
      .def(
          "add_shape",
          [](ModelSpec& s, const std::string& name, int body, const std::string& kind, const V3<double>& pos,
             const V4<double>& quat, const V3<double>& size, double rounding, const V3<double>& origin, double spacing,
             const std::optional<Array<float>>& coefficients) {
            return s.add_shape(name, body, kind, pos, quat, size, rounding, grid_of(origin, spacing, coefficients));
          },
          py::arg("name"), py::arg("body"), py::arg("kind"), py::arg("pos"), py::arg("quat"), py::arg("size"),
          py::arg("rounding") = 0., py::arg("origin") = V3<double>(0, 0, 0), py::arg("spacing") = 0.,
          py::arg("coefficients") = py::none())
      .def(
          "add_points",
          [](ModelSpec& s, const std::string& name, int body, const Array<double>& points,
             const std::vector<double>& weights, double radius, const V3<double>& pos, const V4<double>& quat,
             const std::optional<Array<double>>& areas) {
            return s.add_points(name, body, points_of(points, "points"), weights, radius, pos, quat,
                                areas ? points_of(*areas, "areas") : std::vector<V3<double>>{});
          },
          py::arg("name"), py::arg("body"), py::arg("points"), py::arg("weights"), py::arg("radius") = 0.,
          py::arg("pos") = origin, py::arg("quat") = upright, py::arg("areas") = py::none())
      .def(
          "add_contact",
          [](ModelSpec& s, const std::string& name, int points, int shape, const std::string& law,
             const std::string& damping, double kn, double kt, double mu, double kd,
             double ks) { return s.add_contact(name, points, shape, law, damping, {kn, kt, mu, kd, ks}); },
          py::arg("name"), py::arg("points"), py::arg("shape"), py::arg("law") = "viscous",
          py::arg("damping") = "depth", py::arg("kn"), py::arg("kt"), py::arg("mu"), py::arg("kd"), py::arg("ks") = 0.)
      .def(
          "add_pad",
          [](ModelSpec& s, const std::string& name, int body, const Array<double>& positions,
             const Array<double>& axes_x, const Array<double>& axes_y, const Array<double>& axes_z,
             const std::vector<int>& shapes, const std::string& law, double kn, double kt, double mu, double kd,
             double ks, const std::optional<std::vector<double>>& weights, const V3<double>& pos,
             const V4<double>& quat, bool pushes) {
            const auto p = points_of(positions, "positions");
            const auto x = points_of(axes_x, "axes_x"), y = points_of(axes_y, "axes_y"),
                       z = points_of(axes_z, "axes_z");
            if (x.size() != p.size() || y.size() != p.size() || z.size() != p.size()) {
              throw std::invalid_argument("pad '" + name + "': axes must have one row per marker");
            }
            std::vector<M3<double>> frames(p.size());
            for (std::size_t i = 0; i < p.size(); ++i) frames[i] << x[i], y[i], z[i];
            return s.add_pad(name, body, p, frames, shapes, law, {kn, kt, mu, kd, ks},
                             weights ? *weights : std::vector<double>(p.size(), 1.0), pos, quat, pushes);
          },
          py::arg("name"), py::arg("body"), py::arg("positions"), py::arg("axes_x"), py::arg("axes_y"),
          py::arg("axes_z"), py::arg("shapes"), py::arg("law") = "viscous", py::arg("kn"), py::arg("kt"), py::arg("mu"),
          py::arg("kd"), py::arg("ks") = 0., py::arg("weights") = py::none(), py::arg("pos") = origin,
          py::arg("quat") = upright, py::arg("pushes") = false)
      .def("add_actuator", &ModelSpec::add_actuator, py::arg("name"), py::arg("joint"), py::arg("kind"),
           py::arg("gear") = 1., py::arg("kp") = 0., py::arg("kd") = 0., py::arg("force_lower") = -inf,
           py::arg("force_upper") = inf, py::arg("ctrl_lower") = -inf, py::arg("ctrl_upper") = inf,
           py::arg("gain") = 1., py::arg("bias") = 0.);

  py::class_<Model, std::shared_ptr<Model>>(module, "Model")
      .def(py::init([](const ModelSpec& spec) { return std::make_shared<Model>(spec.build()); }), py::arg("spec"))
      .def_readonly("nq", &Model::nq)
      .def_readonly("nv", &Model::nv)
      .def_readonly("na", &Model::na)
      .def_readonly("markers", &Model::markers)
      .def_readonly("step", &Model::step)
      .def_property_readonly("nu", [](const Model& m) { return m.actuators.size(); })
      .def_readonly("q0", &Model::q0)
      .def_readonly("param_names", &Model::param_names)
      .def_readonly("param_defaults", &Model::param_defaults)
      .def("distance", &distance_at, py::arg("shape"), py::arg("points"),
           "Distance (n), normal (n, 3) and curvature (n, 3, 3) of a shape at points (n, 3) of its frame.")
      .def_property_readonly("body_names", [](const Model& m) { return names(m.bodies); })
      .def_property_readonly("joint_names", [](const Model& m) { return names(m.joints); })
      .def_property_readonly("contact_names", [](const Model& m) { return names(m.contacts); })
      .def_property_readonly("pad_names", [](const Model& m) { return names(m.pads); })
      .def_property_readonly("actuator_names", [](const Model& m) { return names(m.actuators); })
      .def_property_readonly("joint_q",
                             [](const Model& m) {
                               std::vector<int> r;
                               for (const auto& j : m.joints) r.push_back(j.q);
                               return r;
                             })
      .def_property_readonly("joint_v",
                             [](const Model& m) {
                               std::vector<int> r;
                               for (const auto& j : m.joints) r.push_back(j.v);
                               return r;
                             })
      .def_property_readonly("pad_markers", [](const Model& m) {
        std::vector<std::pair<int, int>> r;  // first marker, count
        for (const auto& p : m.pads) r.emplace_back(p.first_marker, p.cloud.size());
        return r;
      });

  bind_batch<double>(module, "Batch");
  bind_batch<float>(module, "BatchFloat");
  module.def("directional_rollout", &directional, py::arg("model"), py::arg("params"), py::arg("q"), py::arg("v"),
             py::arg("anchors"), py::arg("anchored"), py::arg("history"), py::arg("u"), py::arg("dparams"),
             py::arg("dq"), py::arg("dv"), py::arg("danchors"), py::arg("dhistory"), py::arg("du"),
             "Derivative of a rollout of one environment along one direction, by dual numbers (for checking).");
}
