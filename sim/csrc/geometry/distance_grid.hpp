// A shape given by its signed distances on a regular grid: the coefficients of a tri-cubic B-spline, shared by all
// environments. What is done with them stands in grid_shape.hpp.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "math/spatial.hpp"

namespace gelflow {

struct DistanceGrid {
  std::array<int, 3> cells;         // the box that the spline is known on; nothing outside it is touched
  V3<double> origin;                // its lowest corner
  double spacing;                   // edge of a cell
  std::vector<float> coefficients;  // cells + 3 along each axis, z fastest; single precision: nanometres on a decimetre

  // Per cell: how many cells away, diagonal steps counting one, the nearest one is in which the spline may be negative;
  // at most 255. A cell where all 64 coefficients are positive is not among those: the spline is a mean of them.
  std::vector<std::uint8_t> clearance;

  // Throws std::invalid_argument where the numbers make no grid, or the shape reaches the grid's border.
  DistanceGrid(const std::array<int, 3>& cells, const V3<double>& origin, double spacing,
               std::vector<float> coefficients);

  int stride(int axis) const { return axis == 2 ? 1 : axis == 1 ? cells[2] + 3 : (cells[1] + 3) * (cells[2] + 3); }
  int cell(int i, int j, int k) const { return (i * cells[1] + j) * cells[2] + k; }
};

}  // namespace gelflow
