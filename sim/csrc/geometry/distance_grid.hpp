// A signed distance grid: the coefficients of a tri-cubic B-spline, shared by all environments. Its evaluation is in
// grid_shape.hpp.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "math/spatial.hpp"

namespace gelflow {

struct DistanceGrid {
  std::array<int, 3> cells;         // of the box where the spline is defined; points outside are not in contact
  V3<double> origin;                // its lowest corner
  double spacing;                   // edge length of a cell [m]
  std::vector<float> coefficients;  // cells + 3 along each axis, z fastest; single precision resolves nanometres

  // Per cell: Chebyshev distance in cells to the nearest cell in which the spline may be negative, at most 255. Where all
  // 64 coefficients of a cell are positive the spline is positive, as their weighted mean.
  std::vector<std::uint8_t> clearance;

  // Throws std::invalid_argument if the data is inconsistent or the shape reaches the border of the grid.
  DistanceGrid(const std::array<int, 3>& cells, const V3<double>& origin, double spacing,
               std::vector<float> coefficients);

  int stride(int axis) const { return axis == 2 ? 1 : axis == 1 ? cells[2] + 3 : (cells[1] + 3) * (cells[2] + 3); }
  int cell(int i, int j, int k) const { return (i * cells[1] + j) * cells[2] + k; }
};

}  // namespace gelflow
