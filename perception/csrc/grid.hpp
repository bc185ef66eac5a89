// Topology of the marker grid. Markers are numbered row by row.
#pragma once

namespace gelflow::perception {

struct Grid {
  int rows, cols;

  // Directions to the eight neighbours: the first `axis_directions` along the axes (right, left, down, up), then the
  // diagonals; direction d ^ 1 is opposite to direction d.
  static constexpr int directions = 8, axis_directions = 4, rightward = 0, downward = 2;
  static constexpr int row_offset[directions] = {0, 0, 1, -1, 1, -1, 1, -1};
  static constexpr int col_offset[directions] = {1, -1, 0, 0, 1, -1, -1, 1};

  int size() const { return rows * cols; }
  // The marker `steps` steps away in `direction`, or −1 outside the grid.
  int neighbour(int marker, int direction, int steps = 1) const {
    const int row = marker / cols + steps * row_offset[direction], col = marker % cols + steps * col_offset[direction];
    return row >= 0 && row < rows && col >= 0 && col < cols ? row * cols + col : -1;
  }
};

}  // namespace gelflow::perception
