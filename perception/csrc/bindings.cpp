// The Python module gelflow.perception._tracker: thin, all checks of shapes are here.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <limits>
#include <mutex>

#include "tracker.hpp"

namespace py = pybind11;
using namespace gelflow::perception;

namespace {

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Image = py::array_t<std::uint8_t, py::array::c_style>;

template <class T>
void expect(const Array<T>& array, py::ssize_t first, py::ssize_t second, const char* name) {
  const bool fits = second ? array.ndim() == 2 && array.shape(0) == first && array.shape(1) == second
                           : array.ndim() == 1 && array.shape(0) == first;
  if (!fits) throw std::invalid_argument(std::string(name) + " has another shape than the grid asks for");
}

// A tracker with the lock that lets threads share it while the interpreter is free.
struct Shared {
  Tracker tracker;
  std::mutex busy;

  explicit Shared(Setup setup) : tracker(std::move(setup)) {}

  const std::uint8_t* pixels(const Image& image) const {
    const Setup& setup = tracker.setup();
    if (image.ndim() != 3 || image.shape(0) != setup.height || image.shape(1) != setup.width || image.shape(2) != 3)
      throw std::invalid_argument("expected an image of the setup's height and width with three channels");
    return image.data();
  }
};

Setup make_setup(int width, int height, int channel, bool bright, int rows, int cols, double spacing, double radius,
                 double noise, const Array<float>& profile, float reach, const Array<double>& rest,
                 const Array<bool>& seen, const Array<double>& oval, const Array<double>& contrast) {
  const bool sound = width > 0 && height > 0 && rows > 0 && cols > 0 && channel >= 0 && channel <= 5 && radius > 0.5 &&
                     radius < 16 && spacing > 2 * radius && spacing < 1e4 && noise >= 0 && reach > 0;
  if (!sound) throw std::invalid_argument("a setting of the tracker is out of range");
  const py::ssize_t n = py::ssize_t(rows) * cols;
  expect(rest, n, 2, "rest"), expect(oval, n, 3, "oval"), expect(seen, n, 0, "seen");
  expect(contrast, n, 0, "contrast"), expect(profile, Shape::steps + 1, 0, "profile");
  Setup setup{width, height, {rows, cols}, Channel(channel), bright, spacing, radius, noise, {}, {}, {}, {}, {}};
  for (py::ssize_t i = 0; i <= Shape::steps; ++i) setup.shape.value[std::size_t(i)] = profile.at(i);
  setup.shape.reach = reach;
  for (py::ssize_t m = 0; m < n; ++m) {
    setup.rest.push_back({rest.at(m, 0), rest.at(m, 1)});
    setup.seen.push_back(char(seen.at(m)));
    setup.oval.push_back({float(oval.at(m, 0)), float(oval.at(m, 1)), float(oval.at(m, 2))});
    setup.contrast.push_back(contrast.at(m));
    const Oval& q = setup.oval.back();
    const bool round = q.xx > 0 && q.xx < 16 && q.yy > 0 && q.yy < 16 && double(q.xx) * q.yy > double(q.xy) * q.xy;
    const bool known = std::abs(rest.at(m, 0)) < 1e6 && std::abs(rest.at(m, 1)) < 1e6 &&
                       std::abs(contrast.at(m)) > 1e-3 && std::abs(contrast.at(m)) < 1e3;
    if (!round || !known) throw std::invalid_argument("a marker's place, oval or contrast is out of range");
  }
  return setup;
}

py::tuple start(Shared& shared, const Image& image) {
  const std::uint8_t* pixels = shared.pixels(image);
  {
    py::gil_scoped_release free;
    const std::lock_guard lock(shared.busy);
    shared.tracker.start(pixels);
  }
  const py::ssize_t n = shared.tracker.markers();
  py::array_t<double> position({n, py::ssize_t(2)}), contrast(n), quality(n);
  for (py::ssize_t m = 0; m < n; ++m) {
    const std::size_t i = std::size_t(m);
    position.mutable_at(m, 0) = shared.tracker.places()[i].x, position.mutable_at(m, 1) = shared.tracker.places()[i].y;
    contrast.mutable_at(m) = shared.tracker.contrasts()[i], quality.mutable_at(m) = shared.tracker.quality()[i];
  }
  return py::make_tuple(position, contrast, quality);
}

py::array_t<double> rest(Shared& shared) {
  const std::lock_guard lock(shared.busy);
  const std::vector<Point>& places = shared.tracker.setup().rest;
  py::array_t<double> out({py::ssize_t(places.size()), py::ssize_t(2)});
  for (std::size_t m = 0; m < places.size(); ++m) {
    out.mutable_at(py::ssize_t(m), 0) = places[m].x, out.mutable_at(py::ssize_t(m), 1) = places[m].y;
  }
  return out;
}

py::tuple track(Shared& shared, const Image& image) {
  const std::uint8_t* pixels = shared.pixels(image);
  const py::ssize_t n = shared.tracker.markers();
  py::array_t<double> position({n, py::ssize_t(2)}), displacement({n, py::ssize_t(2)}), quality(n);
  py::array_t<bool> valid(n), inferred(n);
  auto p = position.mutable_unchecked<2>(), d = displacement.mutable_unchecked<2>();
  auto q = quality.mutable_unchecked<1>();
  auto v = valid.mutable_unchecked<1>(), g = inferred.mutable_unchecked<1>();
  {
    py::gil_scoped_release free;
    const std::lock_guard lock(shared.busy);
    Tracker& tracker = shared.tracker;
    tracker.track(pixels);
    const bool any = tracker.anything_valid();
    for (py::ssize_t m = 0; m < n; ++m) {
      const std::size_t i = std::size_t(m);
      const Point place = tracker.places()[i], step = place - tracker.setup().rest[i];
      const double nothing = std::numeric_limits<double>::quiet_NaN();
      p(m, 0) = place.x, p(m, 1) = place.y;
      d(m, 0) = any ? step.x : nothing, d(m, 1) = any ? step.y : nothing;
      q(m) = tracker.quality()[i];
      v(m) = tracker.quality()[i] > 0, g(m) = any && !v(m);
    }
  }
  return py::make_tuple(position, displacement, valid, inferred, quality);
}

}  // namespace

PYBIND11_MODULE(_tracker, module) {
  module.doc() = "The native part of the marker tracker.";
  module.attr("PROFILE_STEPS") = Shape::steps;
  py::class_<Shared>(module, "Tracker")
      .def(py::init([](int width, int height, int channel, bool bright, int rows, int cols, double spacing,
                       double radius, double noise, const Array<float>& profile, float reach, const Array<double>& rest,
                       const Array<bool>& seen, const Array<double>& oval, const Array<double>& contrast) {
             return std::make_unique<Shared>(make_setup(width, height, channel, bright, rows, cols, spacing, radius,
                                                        noise, profile, reach, rest, seen, oval, contrast));
           }),
           py::kw_only(), py::arg("width"), py::arg("height"), py::arg("channel"), py::arg("bright"), py::arg("rows"),
           py::arg("cols"), py::arg("spacing"), py::arg("radius"), py::arg("noise"), py::arg("profile"),
           py::arg("reach"), py::arg("rest"), py::arg("seen"), py::arg("oval"), py::arg("contrast"))
      .def("start", &start, py::arg("image").noconvert())
      .def("rest", &rest)
      .def("track", &track, py::arg("image").noconvert());
}
