// The shape of a dot on a deformed gel.
#pragma once

#include <optional>
#include <vector>

#include "dot_fit.hpp"
#include "grid.hpp"

namespace gelflow::perception {

struct MarkerPositions {
  const Grid& grid;
  const std::vector<Point>& rest;     // [px]
  const std::vector<Point>& now;      // [px]
  const std::vector<char>& measured;  // whether `now` is known
};

struct GridStep {
  Point rest, now;  // [px]
};

// Finite differences of the positions at a marker, to the right or `downward` in the grid; both have the same factor.
// They are central ones of fourth order where the neighbours are measured, and one-sided ones of second order at the
// border of the grid. Nothing where a next neighbour is not measured.
inline std::optional<GridStep> find_step(const MarkerPositions& positions, std::size_t marker, bool downward) {
  const Grid& grid = positions.grid;
  const int m = int(marker), at = downward ? m / grid.cols : m % grid.cols, count = downward ? grid.rows : grid.cols;
  const auto other = [&](int steps) { return std::size_t(m + steps * (downward ? grid.cols : 1)); };
  const auto is_measured = [&](int steps) {
    return at + steps >= 0 && at + steps < count && positions.measured[other(steps)];
  };
  std::array<double, 5> weights;  // of the markers from two steps behind to two steps ahead
  if (at == 0)
    weights = is_measured(2) ? std::array{0.0, 0.0, -3.0, 4.0, -1.0} : std::array{0.0, 0.0, -1.0, 1.0, 0.0};
  else if (at == count - 1)
    weights = is_measured(-2) ? std::array{1.0, -4.0, 3.0, 0.0, 0.0} : std::array{0.0, -1.0, 1.0, 0.0, 0.0};
  else if (is_measured(-2) && is_measured(2))
    weights = {1.0, -8.0, 0.0, 8.0, -1.0};
  else
    weights = {0.0, -1.0, 0.0, 1.0, 0.0};
  GridStep step;
  for (int steps = -2; steps <= 2; ++steps) {
    const double weight = weights[std::size_t(steps + 2)];
    if (weight == 0) continue;
    if (!is_measured(steps)) return {};
    step.rest = step.rest + weight * positions.rest[other(steps)];
    step.now = step.now + weight * positions.now[other(steps)];
  }
  return step;
}

// The shape `f` of a marker's dot on the deformed gel: its frame is F G with G = L₀ L⁻¹, where the columns of L are the
// steps to the right and downward in the grid, and L₀ are those at rest. `unknown` where they cannot be measured.
inline DotShape deformed(const MarkerPositions& positions, std::size_t marker, const DotShape& f,
                         const DotShape& unknown) {
  const std::optional<GridStep> right = find_step(positions, marker, false), down = find_step(positions, marker, true);
  if (!right || !down) return unknown;
  const double area = right->now.x * down->now.y - right->now.y * down->now.x;
  if (!(area > 0.3 * (right->rest.x * down->rest.y - right->rest.y * down->rest.x))) return unknown;
  const double xx = (right->rest.x * down->now.y - down->rest.x * right->now.y) / area;
  const double xy = (down->rest.x * right->now.x - right->rest.x * down->now.x) / area;
  const double yx = (right->rest.y * down->now.y - down->rest.y * right->now.y) / area;
  const double yy = (down->rest.y * right->now.x - right->rest.y * down->now.x) / area;
  return {float(f.xx * xx + f.xy * yx), float(f.xx * xy + f.xy * yy), float(f.yx * xx + f.yy * yx),
          float(f.yx * xy + f.yy * yy), f.waves};
}

}  // namespace gelflow::perception
