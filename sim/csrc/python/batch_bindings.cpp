// Batch and BatchFloat, and the named arrays of rollouts.
#include "batch/batch.hpp"

#include <optional>

#include "interpreter_lock.hpp"
#include "python/arrays.hpp"
#include "python/bindings.hpp"

namespace gelflow {

namespace {

// The arrays of a rollout. Trajectory<T> views them after checks of type and shape.
struct TrajectoryArrays {
  py::array u, q, v, anchors, anchored, history, tactile, read_after, halvings, status, active, stopped_at;
  std::shared_ptr<const TactileReduction> reduction;  // may be null
};
struct TouchStopArrays {
  Array<double> threshold;
  int reference_step, after_step;
};
struct CotangentArrays {
  py::array q, v, anchors_end, history_end, tactile;
};
struct GradientArrays {
  py::array u, q, v, anchors, history, params;
};

// One thread at a time calls a batch. A fork ends the calls of the other threads.
class ExclusiveUse {
 public:
  explicit ExclusiveUse(std::atomic<int>& user) : user_(user) {
    int unused = 0;
    const int self = fork_count() + 1;
    if (user_.compare_exchange_strong(unused, self) || (unused != self && user_.exchange(self) != self)) return;
    throw std::invalid_argument(
        "the simulator is busy with a call of another thread; give each thread its own simulator");
  }
  ~ExclusiveUse() { user_ = 0; }
  ExclusiveUse(const ExclusiveUse&) = delete;
  ExclusiveUse& operator=(const ExclusiveUse&) = delete;

 private:
  std::atomic<int>& user_;
};

std::uint64_t main_thread = 0;  // Python's; set when the module is loaded

// Calls work() without the interpreter's lock. Python's main thread, which alone handles signals, looks for them
// meanwhile: an exception of a handler, as at Ctrl-C, ends the call.
template <class T, class Work>
void call(Batch<T>& b, const Work& work) {
  const ExclusiveUse use(b.calling_thread);
  const bool handles_signals = PyThread_get_thread_ident() == main_thread;
  b.interruption().begin(!handles_signals ? std::function<bool()>() : [] {
    const py::gil_scoped_acquire acquire;
    return PyErr_CheckSignals() != 0;
  });
  {
    const WithoutInterpreterLock released;
    work();
  }
  if (b.interruption().requested()) throw py::error_already_set();
}

template <class T>
py::ssize_t actuators(const Batch<T>& b) {
  return static_cast<py::ssize_t>(b.model->actuators.size());
}

void check_markers(const Model& m, const TactileReduction& reduction) {
  if (reduction.markers() == m.num_markers) return;
  throw std::invalid_argument("reduction is of " + std::to_string(reduction.markers()) + " markers; the scene has " +
                              std::to_string(m.num_markers));
}

template <class T>
Dimensions reading_shape(const Trajectory<T>& r, const Model& m) {
  if (r.reduction != nullptr) return {r.reads, r.environments, r.reduction->rows()};
  return {r.reads, r.environments, m.num_markers, 3};
}

// The memory of an array of a trajectory, which only a rollout writes.
template <class T>
T* memory_of(py::array& array, const Dimensions& shape, const char* name, bool written) {
  return written ? writable<T>(array, shape, name) : const_cast<T*>(readable<T>(array, shape, name));
}

template <class T>
Trajectory<T> checked(const Batch<T>& b, TrajectoryArrays& t, bool written) {
  if (t.u.ndim() != 3) throw std::invalid_argument("u must have shape (steps, environments, actuators)");
  const Model& m = *b.model;
  const py::ssize_t steps = t.u.shape(0), n = b.n, reads = t.read_after.size();
  const int* read_after = readable<int>(t.read_after, {reads}, "read_after");
  for (py::ssize_t i = 0; i < reads; ++i) {
    if (read_after[i] < 0 || read_after[i] > steps || (i > 0 && read_after[i] <= read_after[i - 1])) {
      throw std::invalid_argument("read_after must increase and lie between 0 and the number of steps");
    }
  }
  Trajectory<T> r{.steps = static_cast<int>(steps), .reads = static_cast<int>(reads), .environments = b.n};
  r.end_only = written && steps > 0 && t.q.ndim() > 0 && t.q.shape(0) == 1;
  const py::ssize_t rows = r.end_only ? 1 : steps + 1;
  r.u = readable<T>(t.u, {steps, n, actuators(b)}, "u");
  r.q = memory_of<T>(t.q, {rows, n, m.nq}, "q", written);
  r.v = memory_of<T>(t.v, {rows, n, m.nv}, "v", written);
  r.anchors = memory_of<T>(t.anchors, {rows, n, m.na, 3}, "anchors", written);
  r.anchored = memory_of<std::uint8_t>(t.anchored, {rows, n, m.na}, "anchored", written);
  r.history = memory_of<T>(t.history, {rows, n, m.nh}, "history", written);
  r.halvings = memory_of<std::int8_t>(t.halvings, {steps, n}, "halvings", written);
  r.status = memory_of<std::int32_t>(t.status, {n}, "status", written);
  r.active = readable<std::uint8_t>(t.active, {n}, "active");
  r.stopped_at = memory_of<std::int32_t>(t.stopped_at, {n}, "stopped_at", written);
  r.read_after = read_after;
  r.reduction = t.reduction.get();
  if (r.reduction != nullptr) check_markers(m, *r.reduction);
  r.tactile = memory_of<T>(t.tactile, reading_shape(r, m), "tactile", written);
  return r;
}

TouchStop checked(const TouchStopArrays& stop, int n, int steps) {
  if (stop.reference_step < 0 || stop.after_step <= stop.reference_step || stop.after_step > steps) {
    throw std::invalid_argument("a touch stop needs 0 ≤ reference_step < after_step ≤ number of steps, got " +
                                std::to_string(stop.reference_step) + ", " + std::to_string(stop.after_step) + ", " +
                                std::to_string(steps));
  }
  return {stop.reference_step, stop.after_step, readable<double>(stop.threshold, {n}, "threshold")};
}

// The flags of a mask, or null for all environments.
using Mask = std::optional<Array<std::uint8_t>>;
template <class T>
const std::uint8_t* flags(const Batch<T>& b, const Mask& mask, const char* name) {
  if (mask) check_shape(*mask, {b.n}, name);
  return mask ? mask->data() : nullptr;
}

template <class T>
TrajectoryCotangent<T> checked(const Batch<T>& b, const Trajectory<T>& r, const CotangentArrays& c) {
  const Model& m = *b.model;
  const py::ssize_t n = b.n;
  return {readable<T>(c.q, {r.steps + 1, n, m.nq}, "q"), readable<T>(c.v, {r.steps + 1, n, m.nv}, "v"),
          readable<T>(c.anchors_end, {n, m.na, 3}, "anchors_end"), readable<T>(c.history_end, {n, m.nh}, "history_end"),
          readable<T>(c.tactile, reading_shape(r, m), "tactile")};
}

// Controls (N, nu), or (nu,) for all environments.
template <class T>
Controls<T> checked_controls(const Batch<T>& b, const Array<T>& u) {
  const py::ssize_t nu = actuators(b);
  const bool shared = u.ndim() == 1 && u.shape(0) == nu;
  if (!shared && !(u.ndim() == 2 && u.shape(0) == b.n && u.shape(1) == nu)) {
    throw std::invalid_argument("u must have shape " + shape_text({b.n, nu}) + " or (" + std::to_string(nu) +
                                ",), got " + shape_text({u.shape(), u.shape() + u.ndim()}));
  }
  return {u.data(), shared};
}

void bind_trajectory(py::module_& module) {
  using A = py::array;
  py::class_<TrajectoryArrays>(module, "Trajectory")
      .def(py::init([](A u, A q, A v, A anchors, A anchored, A history, A tactile, A read_after, A halvings, A status,
                       A active, A stopped_at, std::shared_ptr<TactileReduction> reduction) {
             return TrajectoryArrays{u,          q,        v,      anchors, anchored,   history,  tactile,
                                     read_after, halvings, status, active,  stopped_at, reduction};
           }),
           py::kw_only(), py::arg("u"), py::arg("q"), py::arg("v"), py::arg("anchors"), py::arg("anchored"),
           py::arg("history"), py::arg("tactile"), py::arg("read_after"), py::arg("halvings"), py::arg("status"),
           py::arg("active"), py::arg("stopped_at"), py::arg("reduction") = py::none())
      .def_readonly("u", &TrajectoryArrays::u)
      .def_readonly("q", &TrajectoryArrays::q)
      .def_readonly("v", &TrajectoryArrays::v)
      .def_readonly("anchors", &TrajectoryArrays::anchors)
      .def_readonly("anchored", &TrajectoryArrays::anchored)
      .def_readonly("history", &TrajectoryArrays::history)
      .def_readonly("tactile", &TrajectoryArrays::tactile)
      .def_readonly("read_after", &TrajectoryArrays::read_after)
      .def_readonly("halvings", &TrajectoryArrays::halvings)
      .def_readonly("status", &TrajectoryArrays::status)
      .def_readonly("active", &TrajectoryArrays::active)
      .def_readonly("stopped_at", &TrajectoryArrays::stopped_at)
      .def_property_readonly("reduction", [](const TrajectoryArrays& t) { return t.reduction; });
  py::class_<CotangentArrays>(module, "TrajectoryCotangent")
      .def(py::init([](A q, A v, A anchors_end, A history_end, A tactile) {
             return CotangentArrays{q, v, anchors_end, history_end, tactile};
           }),
           py::kw_only(), py::arg("q"), py::arg("v"), py::arg("anchors_end"), py::arg("history_end"),
           py::arg("tactile"))
      .def_readonly("q", &CotangentArrays::q)
      .def_readonly("v", &CotangentArrays::v)
      .def_readonly("anchors_end", &CotangentArrays::anchors_end)
      .def_readonly("history_end", &CotangentArrays::history_end)
      .def_readonly("tactile", &CotangentArrays::tactile);
  py::class_<GradientArrays>(module, "TrajectoryGradient")
      .def_readonly("u", &GradientArrays::u)
      .def_readonly("q", &GradientArrays::q)
      .def_readonly("v", &GradientArrays::v)
      .def_readonly("anchors", &GradientArrays::anchors)
      .def_readonly("history", &GradientArrays::history)
      .def_readonly("params", &GradientArrays::params);
}

void bind_reading_options(py::module_& module) {
  py::class_<TactileReduction, std::shared_ptr<TactileReduction>>(module, "TactileReduction")
      .def(py::init([](const Array<double>& matrix) {
             if (matrix.ndim() != 3 || matrix.shape(2) != 3) {
               throw std::invalid_argument("matrix must have shape (rows, markers, 3)");
             }
             return std::make_shared<TactileReduction>(static_cast<int>(matrix.shape(0)),
                                                       static_cast<int>(matrix.shape(1)), matrix.data());
           }),
           py::arg("matrix"))
      .def_property_readonly("rows", &TactileReduction::rows)
      .def_property_readonly("markers", &TactileReduction::markers);
  py::class_<TouchStopArrays>(module, "TouchStop")
      .def(py::init([](const Array<double>& threshold, int reference_step, int after_step) {
             return TouchStopArrays{threshold, reference_step, after_step};
           }),
           py::kw_only(), py::arg("threshold"), py::arg("reference_step"), py::arg("after_step"))
      .def_readonly("threshold", &TouchStopArrays::threshold)
      .def_readonly("reference_step", &TouchStopArrays::reference_step)
      .def_readonly("after_step", &TouchStopArrays::after_step);
}

template <class T>
GradientArrays rollout_vjp(Batch<T>& b, TrajectoryArrays& trajectory, const CotangentArrays& cotangent, bool params) {
  const Trajectory<T> r = checked<T>(b, trajectory, false);
  const TrajectoryCotangent<T> c = checked<T>(b, r, cotangent);
  const Model& m = *b.model;
  const py::ssize_t n = b.n, np = params ? static_cast<py::ssize_t>(m.param_names.size()) : 0;
  py::array_t<T> u(Dimensions{r.steps, n, actuators(b)}), q(Dimensions{n, m.nq}), v(Dimensions{n, m.nv});
  py::array_t<T> anchors(Dimensions{n, m.na, 3}), history(Dimensions{n, m.nh});
  py::array_t<double> grad_params(Dimensions{n, np});
  const TrajectoryGradient<T> gradient{u.mutable_data(),       q.mutable_data(),
                                       v.mutable_data(),       anchors.mutable_data(),
                                       history.mutable_data(), params ? grad_params.mutable_data() : nullptr};
  call(b, [&] { b.rollout_vjp(r, c, gradient); });
  return {u, q, v, anchors, history, grad_params};
}

template <class T>
void bind_state(py::class_<Batch<T>>& type) {
  using B = Batch<T>;
  // An array of the batch's own memory.
  const auto own = [&](const char* name, auto member, auto shape) {
    type.def_property_readonly(name, [member, shape](const py::object& self) {
      B& b = self.cast<B&>();
      Dimensions dimensions = shape(*b.model);
      dimensions.insert(dimensions.begin(), b.n);
      return view((b.*member).data(), dimensions, self);
    });
  };
  const auto none = [](const Model&) { return Dimensions{}; };
  own("q", &B::q, [](const Model& m) { return Dimensions{m.nq}; });
  own("v", &B::v, [](const Model& m) { return Dimensions{m.nv}; });
  own("params", &B::params, [](const Model& m) { return Dimensions{static_cast<py::ssize_t>(m.param_names.size())}; });
  own("anchored", &B::anchored, [](const Model& m) { return Dimensions{m.na}; });
  own("history", &B::history, [](const Model& m) { return Dimensions{m.nh}; });
  own("status", &B::status, none);
  own("iterations", &B::iterations, none);
  own("halved", &B::halved, none);
  type.def_property_readonly("anchors",
                             [](const py::object& self) {
                               B& b = self.cast<B&>();
                               return view(reinterpret_cast<T*>(b.anchors.data()), {b.n, b.model->na, 3}, self);
                             })
      .def_property_readonly("readings", [](const py::object& self) {
        B& b = self.cast<B&>();
        py::array readings = view(b.readings.data(), {b.n, b.model->num_markers, 3}, self);
        readings.attr("flags").attr("writeable") = false;
        return readings;
      });
}

template <class T>
void bind_steps(py::class_<Batch<T>>& type) {
  using B = Batch<T>;
  type.def(
          "reset",
          [](B& b, const Mask& which) {
            const std::uint8_t* const mask = flags(b, which, "which");
            call(b, [&] { b.reset(mask); });
          },
          py::arg("which") = py::none())
      .def(
          "step",
          [](B& b, const Array<T>& u, int steps, const Mask& active) {
            const Controls<T> controls = checked_controls<T>(b, u);
            const std::uint8_t* const mask = flags(b, active, "active");
            call(b, [&] { b.step(controls, steps, mask); });
          },
          py::arg("u"), py::arg("steps") = 1, py::arg("active") = py::none())
      .def(
          "error_estimate",
          [](B& b, const Array<T>& u) {
            const Controls<T> controls = checked_controls<T>(b, u);
            py::array_t<T> out(Dimensions{b.n, b.model->nv});
            py::array_t<std::int32_t> status(static_cast<py::ssize_t>(b.n));
            T* const differences = out.mutable_data();
            std::int32_t* const failures = status.mutable_data();
            call(b, [&] { b.error_estimate(controls, differences, failures); });
            return py::make_tuple(out, status);
          },
          py::arg("u"))
      .def(
          "rollout",
          [](B& b, TrajectoryArrays& trajectory, const std::optional<TouchStopArrays>& stop) {
            const Trajectory<T> r = checked<T>(b, trajectory, true);
            const std::optional<TouchStop> touch =
                stop ? std::optional<TouchStop>(checked(*stop, b.n, r.steps)) : std::nullopt;
            call(b, [&] { b.rollout(r, touch ? &*touch : nullptr); });
          },
          py::arg("trajectory"), py::arg("stop") = py::none())
      .def(
          "contact_modes",
          [](B& b, TrajectoryArrays& trajectory) {
            const Trajectory<T> r = checked<T>(b, trajectory, false);
            py::array_t<std::uint64_t> out(Dimensions{r.steps, b.n});
            std::uint64_t* const signatures = out.mutable_data();
            call(b, [&] { b.contact_modes(r, signatures); });
            return out;
          },
          py::arg("trajectory"))
      .def("rollout_vjp", &rollout_vjp<T>, py::arg("trajectory"), py::arg("cotangent"), py::arg("params") = false);
}

template <class T>
void bind_outputs(py::class_<Batch<T>>& type) {
  using B = Batch<T>;
  // A member function that writes an array of the caller.
  const auto writes = [&](const char* name, void (B::*function)(T*), auto shape) {
    type.def(
        name,
        [function, shape](B& b, py::array out) {
          Dimensions dimensions = shape(*b.model);
          dimensions.insert(dimensions.begin(), b.n);
          T* const data = writable<T>(out, dimensions, "out");
          call(b, [&] { (b.*function)(data); });
        },
        py::arg("out"));
  };
  writes("wrenches", &B::wrenches,
         [](const Model& m) { return Dimensions{static_cast<py::ssize_t>(m.contacts.size()), 6}; });
  writes("contact_forces", &B::contact_forces, [](const Model& m) { return Dimensions{m.nv}; });
  writes("poses", &B::poses, [](const Model& m) { return Dimensions{static_cast<py::ssize_t>(m.bodies.size()), 7}; });
  writes("mass_matrix", &B::mass_matrix, [](const Model& m) { return Dimensions{m.nv, m.nv}; });
  writes("bias", &B::bias, [](const Model& m) { return Dimensions{m.nv}; });
  type.def(
          "tactile",
          [](B& b, py::array out, const Mask& active) {
            T* data = writable<T>(out, {b.n, b.model->num_markers, 3}, "out");
            const std::uint8_t* const mask = flags(b, active, "active");
            call(b, [&] { b.tactile(data, mask); });
          },
          py::arg("out"), py::arg("active") = py::none())
      .def(
          "reduced_tactile",
          [](B& b, const TactileReduction& reduction, py::array out, const Mask& active) {
            check_markers(*b.model, reduction);
            T* data = writable<T>(out, {b.n, reduction.rows()}, "out");
            const std::uint8_t* const mask = flags(b, active, "active");
            call(b, [&] { b.reduced_tactile(reduction, data, mask); });
          },
          py::arg("reduction"), py::arg("out"), py::arg("active") = py::none())
      .def(
          "update_readings",
          [](B& b, const Mask& active) {
            const std::uint8_t* const mask = flags(b, active, "active");
            call(b, [&] { b.update_readings(mask); });
          },
          py::arg("active") = py::none());
}

template <class T>
void bind_batch(py::module_& module, const char* name) {
  using B = Batch<T>;
  py::class_<B> type(module, name);
  type.def(py::init<std::shared_ptr<const Model>, int, int>(), py::arg("model"), py::arg("environments"),
           py::arg("threads"))
      .def_readonly("environments", &B::n)
      .def_readwrite("checks_params", &B::checks_params)
      .def_property_readonly("threads", &B::threads);
  bind_state(type);
  bind_steps(type);
  bind_outputs(type);
}

}  // namespace

void bind_batches(py::module_& module) {
  main_thread = py::module_::import("threading").attr("main_thread")().attr("ident").cast<std::uint64_t>();
  bind_reading_options(module);
  bind_trajectory(module);
  bind_batch<double>(module, "Batch");
  bind_batch<float>(module, "BatchFloat");
}

}  // namespace gelflow
