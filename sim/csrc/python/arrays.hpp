// NumPy arrays at the border: shape checks, views without copies, and conversions of small vectors.
#pragma once

#include <pybind11/eigen.h>
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <stdexcept>
#include <string>
#include <vector>

#include "math/spatial.hpp"

namespace gelflow {

namespace py = pybind11;

template <class T>
using Array = py::array_t<T, py::array::c_style>;
using Dimensions = std::vector<py::ssize_t>;

inline std::string shape_text(const Dimensions& shape) {
  std::string text = "(";
  for (std::size_t i = 0; i < shape.size(); ++i) text += (i ? ", " : "") + std::to_string(shape[i]);
  return text + (shape.size() == 1 ? ",)" : ")");
}

inline void check_shape(const py::array& array, const Dimensions& shape, const char* name) {
  const Dimensions got(array.shape(), array.shape() + array.ndim());
  if (got != shape) {
    throw std::invalid_argument(std::string(name) + " must have shape " + shape_text(shape) + ", got " +
                                shape_text(got));
  }
}

// The memory of an array that is passed without a copy.
template <class T>
const T* readable(const py::array& array, const Dimensions& shape, const char* name) {
  if (!py::isinstance<Array<T>>(array)) {
    throw std::invalid_argument(std::string(name) + " must be a C-contiguous array of the batch's precision");
  }
  check_shape(array, shape, name);
  return static_cast<const T*>(array.data());
}
template <class T>
T* writable(py::array& array, const Dimensions& shape, const char* name) {
  readable<T>(array, shape, name);
  if (!array.writeable()) throw std::invalid_argument(std::string(name) + " must be writable");
  return static_cast<T*>(array.mutable_data());
}

// An array of memory that `owner` keeps alive.
template <class T>
py::array view(T* data, const Dimensions& shape, const py::object& owner) {
  return py::array_t<T>(shape, data, owner);
}

// (n, 3) to vectors and back.
inline std::vector<V3<double>> points_of(const Array<double>& array, const char* name) {
  if (array.ndim() != 2 || array.shape(1) != 3) {
    throw std::invalid_argument(std::string(name) + " must have shape (n, 3)");
  }
  std::vector<V3<double>> points;
  for (py::ssize_t i = 0; i < array.shape(0); ++i) points.emplace_back(array.at(i, 0), array.at(i, 1), array.at(i, 2));
  return points;
}
inline py::array_t<double> array_of(const std::vector<V3<double>>& points) {
  const auto n = static_cast<py::ssize_t>(points.size());
  return py::array_t<double>(Dimensions{n, 3}, reinterpret_cast<const double*>(points.data()));
}

// (n, 3, 3) to matrices and back.
inline std::vector<M3<double>> matrices_of(const Array<double>& array, const char* name) {
  if (array.ndim() != 3 || array.shape(1) != 3 || array.shape(2) != 3) {
    throw std::invalid_argument(std::string(name) + " must have shape (n, 3, 3)");
  }
  std::vector<M3<double>> matrices(array.shape(0));
  for (py::ssize_t i = 0; i < array.shape(0); ++i) {
    for (int a = 0; a < 3; ++a) {
      for (int b = 0; b < 3; ++b) matrices[i](a, b) = array.at(i, a, b);
    }
  }
  return matrices;
}
inline py::array_t<double> array_of(const std::vector<M3<double>>& matrices) {
  py::array_t<double> array(Dimensions{static_cast<py::ssize_t>(matrices.size()), 3, 3});
  auto entries = array.mutable_unchecked<3>();
  for (py::ssize_t i = 0; i < entries.shape(0); ++i) {
    for (int a = 0; a < 3; ++a) {
      for (int b = 0; b < 3; ++b) entries(i, a, b) = matrices[i](a, b);
    }
  }
  return array;
}

}  // namespace gelflow
