// The centre of a dot on a gel whose displacement is curved over the dot.
//
// A fit finds the centre of a dot's outline. In the frame of the dot, where n is a point of its outline and u the
// displacement, curvature moves the outline by K n n / 2, K = ∂²u/∂n². The part of this motion along the normal that a
// translation of the whole outline explains is (∇²u + 2 ∇(∇·u)) / 8: by that much the centre of the outline is not where
// the centre of the printed dot has moved.
#pragma once

#include <cmath>
#include <vector>

#include "dot_fit.hpp"
#include "grid.hpp"

namespace gelflow::perception {

constexpr double largest_curvature_offset = 0.1;  // [radii]; where neighbours differ more, the gel slips between them

struct GelMotion {
  const Grid& grid;
  const std::vector<Point>& rest;          // positions of the markers at rest [px]
  const std::vector<Point>& displacement;  // [px]
  const std::vector<char>& measured;       // whether the displacement is known
};

// The two neighbours of a marker along a line of the grid; the marker itself where the grid ends.
class OppositeNeighbours {
 public:
  OppositeNeighbours(const GelMotion& motion, std::size_t marker, int direction) : motion_(motion), marker_(marker) {
    const int ahead = motion.grid.neighbour(int(marker), direction);
    const int behind = motion.grid.neighbour(int(marker), direction, -1);
    ahead_ = ahead < 0 ? marker : std::size_t(ahead), behind_ = behind < 0 ? marker : std::size_t(behind);
  }
  bool is_known() const {
    return ahead_ != marker_ && behind_ != marker_ && motion_.measured[ahead_] && motion_.measured[behind_];
  }
  Point sum() const { return motion_.displacement[ahead_] + motion_.displacement[behind_]; }
  Point second_difference() const { return is_known() ? sum() - 2 * motion_.displacement[marker_] : Point{}; }
  // Distance between markers at rest; not finite without neighbours.
  Point step() const {
    return 1.0 / ((ahead_ != marker_) + (behind_ != marker_)) * (motion_.rest[ahead_] - motion_.rest[behind_]);
  }

 private:
  const GelMotion& motion_;
  std::size_t marker_, ahead_, behind_;
};

inline Point to_frame(const DotShape& f, Point p) { return {f.xx * p.x + f.xy * p.y, f.yx * p.x + f.yy * p.y}; }

// The centre of a dot's outline less that of the dot [px], from the displacements of the measured neighbours; second
// differences that a missing neighbour leaves unknown count as zero. `rest_shape` and `shape` are those of the dot at
// rest and on the deformed gel.
inline Point curvature_offset(const GelMotion& motion, std::size_t marker, const DotShape& rest_shape,
                              const DotShape& shape) {
  const OppositeNeighbours row(motion, marker, Grid::rightward), column(motion, marker, Grid::downward);
  const OppositeNeighbours falling(motion, marker, Grid::axis_directions);
  const OppositeNeighbours rising(motion, marker, Grid::axis_directions + 2);
  const Point right = to_frame(rest_shape, row.step()), down = to_frame(rest_shape, column.step());
  const double area = right.x * down.y - right.y * down.x;
  if (!(std::abs(area) > 1e-9)) return {};
  const Point along_row = row.second_difference(), along_column = column.second_difference();
  const Point mixed = falling.is_known() && rising.is_known() ? 0.25 * (falling.sum() - rising.sum()) : Point{};
  // Steps along the row (x) and the column (y) for a unit step along each axis of the frame.
  const Point first = 1 / area * Point{down.y, -right.y}, second = 1 / area * Point{-down.x, right.x};
  const auto curvature = [&](Point a, Point b) {
    return to_frame(shape, a.x * b.x * along_row + (a.x * b.y + a.y * b.x) * mixed + a.y * b.y * along_column);
  };
  const Point xx = curvature(first, first), xy = curvature(first, second), yy = curvature(second, second);
  const Point offset = 0.125 * Point{3 * xx.x + yy.x + 2 * xy.y, 3 * yy.y + xx.y + 2 * xy.x};
  if (!(std::hypot(offset.x, offset.y) < largest_curvature_offset)) return {};
  const auto [x, y] = to_image(shape, offset.x, offset.y);
  return {x, y};
}

}  // namespace gelflow::perception
