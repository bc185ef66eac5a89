#include "geometry/distance_grid.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace gelflow {

namespace {

constexpr int max_coefficients = 1 << 30;

template <class Visit>
void for_cells(const std::array<int, 3>& n, Visit&& visit) {
  for (int i = 0; i < n[0]; ++i) {
    for (int j = 0; j < n[1]; ++j) {
      for (int k = 0; k < n[2]; ++k) visit(i, j, k);
    }
  }
}

bool may_be_negative(const DistanceGrid& g, int i, int j, int k) {
  for (int a = 0; a < 4; ++a) {
    for (int b = 0; b < 4; ++b) {
      const float* c = &g.coefficients[static_cast<std::size_t>((i + a) * g.stride(0) + (j + b) * g.stride(1) + k)];
      if (!(std::min({c[0], c[1], c[2], c[3]}) > 0)) return true;
    }
  }
  return false;
}

// One pass of the distance transform over the cells, in memory order or in reverse: each cell is at most one farther than
// its neighbours before it.
void sweep(DistanceGrid& g, int direction) {
  const std::array<int, 3>& n = g.cells;
  for_cells(n, [&](int i, int j, int k) {
    if (direction < 0) i = n[0] - 1 - i, j = n[1] - 1 - j, k = n[2] - 1 - k;
    std::uint8_t& clearance = g.clearance[static_cast<std::size_t>(g.cell(i, j, k))];
    for (int step = 0; step < 13; ++step) {  // the 13 of 26 neighbours before this cell
      const int di = direction * (step / 9 - 1), dj = direction * (step / 3 % 3 - 1), dk = direction * (step % 3 - 1);
      const int x = i + di, y = j + dj, z = k + dk;
      if (x < 0 || x >= n[0] || y < 0 || y >= n[1] || z < 0 || z >= n[2]) continue;
      const int via_neighbor = g.clearance[static_cast<std::size_t>(g.cell(x, y, z))] + 1;
      if (via_neighbor < clearance) clearance = static_cast<std::uint8_t>(via_neighbor);
    }
  });
}

}  // namespace

DistanceGrid::DistanceGrid(const std::array<int, 3>& n, const V3<double>& lower_corner, double edge,
                           std::vector<float> values)
    : cells(n), origin(lower_corner), spacing(edge), coefficients(std::move(values)) {
  double size = 1;
  for (const int along : cells) {
    if (along < 3) throw std::invalid_argument("a distance grid needs at least 3 cells along each axis");
    size *= along + 3;
  }
  if (size > max_coefficients) throw std::invalid_argument("a distance grid has at most 2^30 coefficients");
  if (static_cast<double>(coefficients.size()) != size) {
    throw std::invalid_argument("a distance grid needs cells + 3 coefficients along each axis");
  }
  if (!(spacing > 0) || !std::isfinite(spacing) || !origin.allFinite()) {
    throw std::invalid_argument("a distance grid needs a positive spacing and a finite origin");
  }
  for (const float c : coefficients) {
    if (!std::isfinite(c)) throw std::invalid_argument("a coefficient of a distance grid is not finite");
  }
  clearance.assign(static_cast<std::size_t>(cells[0]) * cells[1] * cells[2], 255);
  for_cells(cells, [&](int i, int j, int k) {
    if (!may_be_negative(*this, i, j, k)) return;
    const bool border = i == 0 || j == 0 || k == 0 || i == cells[0] - 1 || j == cells[1] - 1 || k == cells[2] - 1;
    if (border) throw std::invalid_argument("a distance grid must have a border of cells outside the shape");
    clearance[static_cast<std::size_t>(cell(i, j, k))] = 0;
  });
  sweep(*this, 1);
  sweep(*this, -1);
}

}  // namespace gelflow
