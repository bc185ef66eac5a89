// The Python module gelflow.perception.force._contact_fit. All array shapes are checked here.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <mutex>
#include <string>

#include "contact_fit.hpp"
#include "interpreter_lock.hpp"

namespace py = pybind11;
using gelflow::WithoutInterpreterLock;
using namespace gelflow::perception;

namespace {

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Shape = std::vector<py::ssize_t>;

template <class T>
const T* checked(const Array<T>& array, const Shape& shape, const char* name) {
  if (Shape(array.shape(), array.shape() + array.ndim()) != shape)
    throw std::invalid_argument(std::string(name) + " has a shape that does not fit the grid");
  return array.data();
}

Values values(const Array<double>& array, const Shape& shape, const char* name) {
  const double* data = checked(array, shape, name);
  return Values(data, data + array.size());
}

template <class T, class Container>
py::array_t<T> to_array(const Container& container, const Shape& shape) {
  py::array_t<T> array(shape);
  std::copy(container.begin(), container.end(), array.mutable_data());
  return array;
}

// The routine of this name that SciPy exports for Cython, so that nothing else is linked. Its signature is the name of
// the capsule, with a type name of Cython for double. Integers of another width would have another signature.
template <class Routine>
void load(Routine*& routine, const char* module, const char* name, const std::string& signature) {
  const py::dict routines = py::module_::import(module).attr("__pyx_capi__");
  const py::capsule capsule = routines[name];
  std::string found = capsule.name();
  for (std::size_t begin; (begin = found.find("__pyx_t_")) != std::string::npos;)
    found.replace(begin, found.find(' ', begin) - begin, "double");
  if (found != signature)
    throw py::import_error(std::string(module) + "." + name + " has the signature " + found + ", expected " +
                           signature + ": install another version of SciPy");
  routine = reinterpret_cast<Routine*>(capsule.get_pointer<void>());
}

LinearAlgebra load_linear_algebra() {
  constexpr const char* blas = "scipy.linalg.cython_blas";
  LinearAlgebra algebra{};
  load(algebra.dgemm, blas, "dgemm",
       "void (char *, char *, int *, int *, int *, double *, double *, int *, double *, int *, double *, double *, int "
       "*)");
  load(algebra.dgemv, blas, "dgemv",
       "void (char *, int *, int *, double *, double *, int *, double *, int *, double *, double *, int *)");
  load(algebra.dsymv, blas, "dsymv",
       "void (char *, int *, double *, double *, int *, double *, int *, double *, double *, int *)");
  load(algebra.dsyrk, blas, "dsyrk",
       "void (char *, char *, int *, int *, double *, double *, int *, double *, double *, int *)");
  load(algebra.dtrsm, blas, "dtrsm",
       "void (char *, char *, char *, char *, int *, int *, double *, double *, int *, double *, int *)");
  load(algebra.dpotrf, "scipy.linalg.cython_lapack", "dpotrf", "void (char *, int *, double *, int *, int *)");
  return algebra;
}

const LinearAlgebra& linear_algebra() {
  static const LinearAlgebra algebra = load_linear_algebra();
  return algebra;
}

// The equations of an image, and the array that contains their matrix.
struct HeldEquations : NormalEquations {
  Array<double> held_gram;
};

// A fitter with a lock, so that threads can share it while the interpreter lock is released.
struct SharedFitter {
  ContactFitter fitter;
  std::mutex mutex;

  explicit SharedFitter(LayerGrid grid) : fitter(linear_algebra(), std::move(grid)) {}

  template <class Fit>
  ContactFit run(const HeldEquations& image, const Fit& fit) {
    if (py::ssize_t(image.projected.size()) != 3 * fitter.grid().cells)
      throw std::invalid_argument("the equations have a size that does not fit the grid");
    const WithoutInterpreterLock released;
    const std::lock_guard lock(mutex);
    return fit(fitter, image);
  }
};

std::unique_ptr<SharedFitter> make_fitter(const Array<double>& position, const Array<double>& correlation,
                                          const Array<double>& smoothing, const Array<double>& roughness,
                                          const Array<double>& compliance) {
  const py::ssize_t n = position.ndim() ? position.shape(0) : 0;
  if (n < 1 || n > 10000) throw std::invalid_argument("expected 1 to 10000 cells");
  LayerGrid grid{int(n),
                 {},
                 {},
                 values(compliance, {2 * n, 3 * n}, "compliance"),
                 values(correlation, {n, n}, "correlation"),
                 values(smoothing, {n, n}, "smoothing"),
                 values(roughness, {n, n}, "roughness")};
  checked(position, {n, 2}, "position");
  for (py::ssize_t i = 0; i < n; ++i) grid.x.push_back(position.at(i, 0)), grid.y.push_back(position.at(i, 1));
  return std::make_unique<SharedFitter>(std::move(grid));
}

HeldEquations equations(SharedFitter& shared, Array<double> gram, const Array<double>& displacement,
                        const Array<bool>& valid, double noise) {
  const py::ssize_t n = shared.fitter.grid().cells;
  checked(gram, {3 * n, 3 * n}, "gram"), checked(displacement, {n, 2}, "displacement"), checked(valid, {n}, "valid");
  Values measured(std::size_t(2 * n), 0.0);
  for (py::ssize_t i = 0; i < n; ++i)
    if (valid.at(i)) {
      measured[std::size_t(i)] = displacement.at(i, 0), measured[std::size_t(n + i)] = displacement.at(i, 1);
    }
  NormalEquations equations = shared.fitter.equations(gram.data(), std::move(measured), 1 / (noise * noise));
  return {std::move(equations), std::move(gram)};
}

ContactFit first(SharedFitter& shared, const HeldEquations& image, const Array<double>& ratios,
                 const Array<double>& scales, double deviation, const Array<double>& centre) {
  const py::ssize_t trials = scales.size();
  if (trials < 1) throw std::invalid_argument("expected at least one ratio");
  checked(ratios, {trials, 2}, "ratios"), checked(centre, {2}, "centre");
  std::vector<std::array<double, 2>> pairs;
  for (py::ssize_t i = 0; i < trials; ++i) pairs.push_back({ratios.at(i, 0), ratios.at(i, 1)});
  const Values of_normal = values(scales, {trials}, "scales");
  const std::array<double, 2> middle{centre.at(0), centre.at(1)};
  return shared.run(image, [&](ContactFitter& fitter, const NormalEquations& equations) {
    return fitter.first(equations, pairs, of_normal, deviation, middle);
  });
}

// A fit that starts from the last one: `ContactFitter::step` or `ContactFitter::follow`.
template <ContactFit (ContactFitter::*improve)(const NormalEquations&, const ContactFit&)>
ContactFit improved(SharedFitter& shared, const HeldEquations& image, const ContactFit& last) {
  if (last.normal.size() != std::size_t(shared.fitter.grid().cells))
    throw std::invalid_argument("the last fit is that of another grid");
  return shared.run(image, [&](ContactFitter& fitter, const NormalEquations& equations) {
    return (fitter.*improve)(equations, last);
  });
}

py::array_t<double> shear(const ContactFit& fit, const Array<double>& position) {
  const py::ssize_t n = py::ssize_t(fit.normal.size());
  checked(position, {n, 2}, "position");
  py::array_t<double> out({py::ssize_t(2), n});
  for (py::ssize_t i = 0; i < n; ++i) {
    const std::size_t s = std::size_t(i);
    const auto [along, across] = fit.shear_at(s, position.at(i, 0), position.at(i, 1));
    out.mutable_at(0, i) = along, out.mutable_at(1, i) = across;
  }
  return out;
}

py::array_t<double> solve_nonnegative(const Array<double>& hessian, const Array<double>& linear,
                                      const Array<bool>& start) {
  const py::ssize_t n = linear.size();
  Values matrix = values(hessian, {n, n}, "hessian");
  const bool* first_set = checked(start, {n}, "start");
  NonnegativeSolver solver(linear_algebra());
  const MatrixView view{matrix.data(), int(n), int(n), std::max(int(n), 1)};
  solver.solve(view, values(linear, {n}, "linear"), std::vector<char>(first_set, first_set + n));
  return to_array<double>(solver.solution(), {n});
}

void bind_fit(py::module_& module) {
  const auto cells = [](const ContactFit& fit) { return py::ssize_t(fit.normal.size()); };
  py::class_<HeldEquations>(module, "NormalEquations")
      .def_property_readonly("projected", [](const HeldEquations& image) {
        return to_array<double>(image.projected, {py::ssize_t(image.projected.size())});
      });
  py::class_<LoadSums>(module, "LoadSums")
      .def_property_readonly("shear", [](const LoadSums& sums) { return to_array<double>(sums.shear, {2}); })
      .def_readonly("normal", &LoadSums::normal)
      .def_property_readonly("centre", [](const LoadSums& sums) { return to_array<double>(sums.centre, {2}); })
      .def_readonly("moment", &LoadSums::moment);
  py::class_<ContactFit>(module, "ContactFit")
      .def_property_readonly("ratio", [](const ContactFit& fit) { return to_array<double>(fit.ratio, {2}); })
      .def_readonly("twist", &ContactFit::twist)
      .def_property_readonly("centre", [](const ContactFit& fit) { return to_array<double>(fit.centre, {2}); })
      .def_property_readonly("normal",
                             [=](const ContactFit& fit) { return to_array<double>(fit.normal, {cells(fit)}); })
      .def_property_readonly("remainder",
                             [=](const ContactFit& fit) { return to_array<double>(fit.remainder, {2, cells(fit)}); })
      .def_readonly("sums", &ContactFit::sums)
      .def_readonly("cost", &ContactFit::cost)
      .def_readonly("unexplained", &ContactFit::unexplained)
      .def_property_readonly("rigid_covariance",
                             [](const ContactFit& fit) { return to_array<double>(fit.rigid_covariance, {4, 4}); })
      .def_property_readonly("wanted", [=](const ContactFit& fit) { return to_array<bool>(fit.wanted, {cells(fit)}); })
      .def("shear", &shear, py::arg("position"));
}

}  // namespace

PYBIND11_MODULE(_contact_fit, module) {
  module.doc() = "Steps of the fit of contact forces.";
  module.attr("SMALLEST_LOAD") = smallest_load;
  module.attr("REMAINDER") = remainder_share;
  module.attr("REMAINDER_FLOOR") = remainder_floor;
  linear_algebra();
  py::register_local_exception_translator([](std::exception_ptr exception) {
    try {
      if (exception) std::rethrow_exception(exception);
    } catch (const NotPositiveDefinite& error) {
      py::set_error(py::module_::import("numpy.linalg").attr("LinAlgError"), error.what());
    }
  });
  bind_fit(module);
  py::class_<SharedFitter>(module, "ContactFitter")
      .def(py::init(&make_fitter), py::kw_only(), py::arg("position"), py::arg("correlation"), py::arg("smoothing"),
           py::arg("roughness"), py::arg("compliance"))
      .def("equations", &equations, py::arg("gram"), py::arg("displacement"), py::arg("valid"), py::arg("noise"))
      .def("first", &first, py::arg("image"), py::kw_only(), py::arg("ratios"), py::arg("scales"), py::arg("deviation"),
           py::arg("centre"))
      .def("step", &improved<&ContactFitter::step>, py::arg("image"), py::arg("last"))
      .def("follow", &improved<&ContactFitter::follow>, py::arg("image"), py::arg("last"));
  module.def("solve_nonnegative", &solve_nonnegative, py::arg("hessian"), py::arg("linear"), py::arg("start"));
}
