// The Python module gelflow.perception._tracker. All array shapes are checked here.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <limits>
#include <mutex>

#include "interpreter_lock.hpp"
#include "tracker.hpp"

namespace py = pybind11;
using gelflow::WithoutInterpreterLock;
using namespace gelflow::perception;

namespace {

template <class T>
using Array = py::array_t<T, py::array::c_style | py::array::forcecast>;
using Image = py::array_t<std::uint8_t, py::array::c_style>;

template <class T>
void check_shape(const Array<T>& array, py::ssize_t first, py::ssize_t second, const char* name) {
  const bool fits = second ? array.ndim() == 2 && array.shape(0) == first && array.shape(1) == second
                           : array.ndim() == 1 && array.shape(0) == first;
  if (!fits) throw std::invalid_argument(std::string(name) + " has a shape that does not fit the grid");
}

// The fit of the first image.
struct StartResult {
  py::array_t<double> position, contrast, quality;
};

// The markers in one image.
struct TrackResult {
  py::array_t<double> position, displacement;
  py::array_t<bool> valid, inferred;
  py::array_t<double> quality;
};

// A tracker with a lock, so that threads can share it while the interpreter lock is released.
struct SharedTracker {
  Tracker tracker;
  std::mutex mutex;

  explicit SharedTracker(TrackerSetup setup) : tracker(std::move(setup)) {}

  const std::uint8_t* pixels(const Image& image) const {
    const TrackerSetup& setup = tracker.setup();
    if (image.ndim() != 3 || image.shape(0) != setup.height || image.shape(1) != setup.width || image.shape(2) != 3)
      throw std::invalid_argument("expected an image of the height and width of the setup with three channels");
    return image.data();
  }
};

bool is_in_range(Point position) { return std::abs(position.x) < 1e6 && std::abs(position.y) < 1e6; }

void check_marker(const TrackerSetup& setup, std::size_t m) {
  const DotShape& f = setup.shape[m];
  const Point rest = setup.rest[m];
  const double contrast = std::abs(setup.contrast[m]);
  const bool regular =
      std::hypot(f.xx, f.xy, f.yx) < 4 && std::abs(f.yy) < 4 && double(f.xx) * f.yy > double(f.xy) * f.yx;
  double raggedness = 0;
  for (const float wave : f.waves) raggedness += std::abs(double(wave));
  const bool bounded = is_in_range(rest) && contrast > 1e-3 && contrast < 1e3;
  const double tolerated = setup.tolerated[m];
  if (!regular || !bounded || !(raggedness < 0.9) || !(tolerated > 0.01 && tolerated < 10))
    throw std::invalid_argument("position, shape, contrast or tolerated residual of a marker is out of range");
}

void set_masks(TrackerSetup& setup, const Array<int>& mask_of, const Array<float>& masks) {
  constexpr py::ssize_t cells = DotMask::cells;
  if (masks.ndim() != 3 || masks.shape(1) != cells || masks.shape(2) != cells)
    throw std::invalid_argument("masks must have shape (masked dots, 32, 32)");
  for (py::ssize_t i = 0; i < masks.shape(0); ++i) {
    DotMask& mask = setup.masks.emplace_back();
    for (py::ssize_t cell = 0; cell < cells * cells; ++cell) {
      const float weight = masks.at(i, cell / cells, cell % cells);
      if (!(weight >= 0 && weight <= 1)) throw std::invalid_argument("a mask has a weight outside 0 to 1");
      mask.weight[std::size_t(cell)] = weight;
    }
  }
  for (py::ssize_t m = 0; m < mask_of.shape(0); ++m) {
    if (mask_of.at(m) < -1 || mask_of.at(m) >= masks.shape(0))
      throw std::invalid_argument("mask_of refers to a mask that does not exist");
    setup.mask_of.push_back(mask_of.at(m));
  }
}

TrackerSetup make_setup(int width, int height, int channel, bool bright, int rows, int cols, double spacing,
                        double radius, double noise, const Array<float>& profile, float profile_reach,
                        const Array<double>& rest, const Array<bool>& visible, const Array<double>& shape,
                        const Array<double>& contrast, const Array<double>& tolerated, const Array<int>& mask_of,
                        const Array<float>& masks) {
  const bool in_range = width > 0 && height > 0 && rows > 0 && cols > 0 && channel >= 0 && channel <= 5 &&
                        radius > 0.5 && radius < 16 && spacing > 2 * radius && spacing < 1e4 && noise >= 0 &&
                        profile_reach > 0;
  if (!in_range) throw std::invalid_argument("a setting of the tracker is out of range");
  const py::ssize_t n = py::ssize_t(rows) * cols;
  check_shape(rest, n, 2, "rest"), check_shape(shape, n, 8, "shape"), check_shape(visible, n, 0, "visible");
  check_shape(contrast, n, 0, "contrast"), check_shape(tolerated, n, 0, "tolerated"),
      check_shape(profile, DotProfile::steps + 1, 0, "profile"), check_shape(mask_of, n, 0, "mask_of");
  TrackerSetup setup{
      width, height, {rows, cols}, Channel(channel), bright, spacing, radius, noise, {}, {}, {}, {}, {}, {}, {}, {}};
  for (py::ssize_t i = 0; i <= DotProfile::steps; ++i) setup.profile.value[std::size_t(i)] = profile.at(i);
  setup.profile.reach = profile_reach;
  for (py::ssize_t m = 0; m < n; ++m) {
    setup.rest.push_back({rest.at(m, 0), rest.at(m, 1)});
    setup.visible.push_back(char(visible.at(m)));
    const auto value = [&](py::ssize_t i) { return float(shape.at(m, i)); };
    setup.shape.push_back({value(0), value(1), value(2), value(3), {value(4), value(5), value(6), value(7)}});
    setup.contrast.push_back(contrast.at(m)), setup.tolerated.push_back(tolerated.at(m));
    check_marker(setup, std::size_t(m));
  }
  set_masks(setup, mask_of, masks);
  return setup;
}

StartResult start(SharedTracker& shared, const Image& image) {
  const std::uint8_t* pixels = shared.pixels(image);
  const py::ssize_t n = shared.tracker.markers();
  StartResult out{py::array_t<double>({n, py::ssize_t(2)}), py::array_t<double>(n), py::array_t<double>(n)};
  auto position = out.position.mutable_unchecked<2>();
  auto contrast = out.contrast.mutable_unchecked<1>(), quality = out.quality.mutable_unchecked<1>();
  const WithoutInterpreterLock released;
  const std::lock_guard lock(shared.mutex);
  shared.tracker.start(pixels);
  for (py::ssize_t m = 0; m < n; ++m) {
    const std::size_t i = std::size_t(m);
    const Point found = shared.tracker.positions()[i];
    position(m, 0) = found.x, position(m, 1) = found.y;
    contrast(m) = shared.tracker.contrasts()[i], quality(m) = shared.tracker.quality()[i];
  }
  return out;
}

py::array_t<double> rest(SharedTracker& shared) {
  const std::lock_guard lock(shared.mutex);
  const std::vector<Point>& positions = shared.tracker.setup().rest;
  py::array_t<double> out({py::ssize_t(positions.size()), py::ssize_t(2)});
  for (std::size_t m = 0; m < positions.size(); ++m) {
    out.mutable_at(py::ssize_t(m), 0) = positions[m].x, out.mutable_at(py::ssize_t(m), 1) = positions[m].y;
  }
  return out;
}

// Runs `step`, which is the next image's, and returns its markers.
template <class Step>
TrackResult next_image(SharedTracker& shared, Step step) {
  const py::ssize_t n = shared.tracker.markers();
  TrackResult out{py::array_t<double>({n, py::ssize_t(2)}), py::array_t<double>({n, py::ssize_t(2)}),
                  py::array_t<bool>(n), py::array_t<bool>(n), py::array_t<double>(n)};
  auto position = out.position.mutable_unchecked<2>(), displacement = out.displacement.mutable_unchecked<2>();
  auto quality = out.quality.mutable_unchecked<1>();
  auto valid = out.valid.mutable_unchecked<1>(), inferred = out.inferred.mutable_unchecked<1>();
  {
    const WithoutInterpreterLock released;
    const std::lock_guard lock(shared.mutex);
    Tracker& tracker = shared.tracker;
    step(tracker);
    const bool any = tracker.anything_valid();
    const double nan = std::numeric_limits<double>::quiet_NaN();
    for (py::ssize_t m = 0; m < n; ++m) {
      const std::size_t i = std::size_t(m);
      const Point now = tracker.positions()[i], moved = now - tracker.setup().rest[i];
      position(m, 0) = now.x, position(m, 1) = now.y;
      displacement(m, 0) = any ? moved.x : nan, displacement(m, 1) = any ? moved.y : nan;
      quality(m) = tracker.quality()[i];
      valid(m) = tracker.quality()[i] > 0, inferred(m) = any && !valid(m);
    }
  }
  return out;
}

TrackResult track(SharedTracker& shared, const Image& image) {
  const std::uint8_t* pixels = shared.pixels(image);
  return next_image(shared, [pixels](Tracker& tracker) { tracker.track(pixels); });
}

TrackResult refine(SharedTracker& shared, const Image& image, const Array<double>& position,
                   const Array<bool>& wanted) {
  const std::uint8_t* pixels = shared.pixels(image);
  const py::ssize_t n = shared.tracker.markers();
  check_shape(position, n, 2, "position"), check_shape(wanted, n, 0, "wanted");
  std::vector<Point> begin;
  std::vector<char> chosen;
  for (py::ssize_t m = 0; m < n; ++m) {
    begin.push_back({position.at(m, 0), position.at(m, 1)}), chosen.push_back(char(wanted.at(m)));
    if (!is_in_range(begin.back())) throw std::invalid_argument("a position of a marker is out of range");
  }
  return next_image(shared, [&](Tracker& tracker) { tracker.refine(pixels, begin, chosen); });
}

}  // namespace

PYBIND11_MODULE(_tracker, module) {
  module.doc() = "The native part of the marker tracker.";
  module.attr("PROFILE_STEPS") = DotProfile::steps;
  module.attr("MASK_CELLS") = DotMask::cells;
  module.attr("MASK_REACH") = DotMask::reach;
  module.attr("LARGEST_REFINEMENT") = largest_refinement;
  py::class_<StartResult>(module, "StartResult")
      .def_readonly("position", &StartResult::position)
      .def_readonly("contrast", &StartResult::contrast)
      .def_readonly("quality", &StartResult::quality);
  py::class_<TrackResult>(module, "TrackResult")
      .def_readonly("position", &TrackResult::position)
      .def_readonly("displacement", &TrackResult::displacement)
      .def_readonly("valid", &TrackResult::valid)
      .def_readonly("inferred", &TrackResult::inferred)
      .def_readonly("quality", &TrackResult::quality);
  py::class_<SharedTracker>(module, "Tracker")
      .def(py::init([](int width, int height, int channel, bool bright, int rows, int cols, double spacing,
                       double radius, double noise, const Array<float>& profile, float profile_reach,
                       const Array<double>& rest, const Array<bool>& visible, const Array<double>& shape,
                       const Array<double>& contrast, const Array<double>& tolerated, const Array<int>& mask_of,
                       const Array<float>& masks) {
             return std::make_unique<SharedTracker>(make_setup(width, height, channel, bright, rows, cols, spacing,
                                                               radius, noise, profile, profile_reach, rest, visible,
                                                               shape, contrast, tolerated, mask_of, masks));
           }),
           py::kw_only(), py::arg("width"), py::arg("height"), py::arg("channel"), py::arg("bright"), py::arg("rows"),
           py::arg("cols"), py::arg("spacing"), py::arg("radius"), py::arg("noise"), py::arg("profile"),
           py::arg("profile_reach"), py::arg("rest"), py::arg("visible"), py::arg("shape"), py::arg("contrast"),
           py::arg("tolerated"), py::arg("mask_of"), py::arg("masks"))
      .def("start", &start, py::arg("image").noconvert())
      .def("rest", &rest)
      .def("track", &track, py::arg("image").noconvert())
      .def("refine", &refine, py::arg("image").noconvert(), py::arg("position"), py::arg("wanted"));
}
