// What the Python module needs for shapes: points and grids from arrays, and a shape's distance at points.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <memory>
#include <optional>

#include "geometry/shapes.hpp"

namespace gelflow {

namespace py = pybind11;

template <class T>
using Array = py::array_t<T, py::array::c_style>;

inline std::vector<V3<double>> points_of(const Array<double>& array, const char* name) {
  if (array.ndim() != 2 || array.shape(1) != 3) {
    throw std::invalid_argument(std::string(name) + " must have shape (n, 3)");
  }
  std::vector<V3<double>> points;
  for (py::ssize_t i = 0; i < array.shape(0); ++i) points.emplace_back(array.at(i, 0), array.at(i, 1), array.at(i, 2));
  return points;
}

inline std::shared_ptr<const DistanceGrid> grid_of(const V3<double>& origin, double spacing,
                                                   const std::optional<Array<float>>& coefficients) {
  if (!coefficients) return nullptr;
  if (coefficients->ndim() != 3) throw std::invalid_argument("coefficients must have shape (x, y, z)");
  std::array<int, 3> cells;
  for (int a = 0; a < 3; ++a) cells[a] = static_cast<int>(coefficients->shape(a)) - 3;
  const float* data = coefficients->data();
  return std::make_shared<DistanceGrid>(cells, origin, spacing, std::vector<float>(data, data + coefficients->size()));
}

// Distance, normal and curvature at points of a shape's frame, by the packs that the simulator uses.
inline py::tuple distance_at(const Model& m, const std::string& name, const Array<double>& points) {
  using P = Pack<double>;
  constexpr int width = pack_width<double>;
  const auto found =
      std::find_if(m.shapes.begin(), m.shapes.end(), [&](const Shape& shape) { return shape.name == name; });
  if (found == m.shapes.end()) throw std::invalid_argument("no shape '" + name + "'");
  const std::vector<V3<double>> x = points_of(points, "points");
  const auto n = static_cast<py::ssize_t>(x.size());
  py::array_t<double> d(n), normal({n, py::ssize_t{3}}), hessian({n, py::ssize_t{3}, py::ssize_t{3}});
  double *to_d = d.mutable_data(), *to_normal = normal.mutable_data(), *to_hessian = hessian.mutable_data();
  for (py::ssize_t begin = 0; begin < n; begin += width) {
    Vec3<P> at;
    for (int k = 0; k < width; ++k) set_lane3<double>(at, k, x[std::min(begin + k, n - 1)]);
    Distance<P> found_at;
    distance<true>(found->kind, m.param_defaults.data() + found->size, found->grid.get(), at, found_at);
    found_at.hessian = found_at.form == HessianForm::zero ? zero33<P>() : found_at.hessian_matrix();
    for (int k = 0; k < width && begin + k < n; ++k) {
      const py::ssize_t i = begin + k;
      to_d[i] = lane(found_at.d, k);
      for (int a = 0; a < 3; ++a) {
        to_normal[3 * i + a] = lane(found_at.n[a], k);
        for (int b = 0; b < 3; ++b) to_hessian[9 * i + 3 * a + b] = lane(found_at.hessian.row[a][b], k);
      }
    }
  }
  return py::make_tuple(d, normal, hessian);
}

}  // namespace gelflow
