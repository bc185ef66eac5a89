// The grid of markers: who is next to whom. Markers are numbered row by row.
#pragma once

namespace gelflow::perception {

struct Grid {
  int rows, cols;

  // Ways to the neighbours: the first four next to a marker (right, left, down, up), the others across; opposite ways
  // beside each other.
  static constexpr int ways = 8, straight = 4, to_the_right = 0, downwards = 2;
  static constexpr int down[ways] = {0, 0, 1, -1, 1, -1, 1, -1};
  static constexpr int right[ways] = {1, -1, 0, 0, 1, -1, -1, 1};

  int size() const { return rows * cols; }
  // The marker so many steps on, or −1 outside the grid.
  int neighbour(int marker, int way, int steps = 1) const {
    const int row = marker / cols + steps * down[way], col = marker % cols + steps * right[way];
    return row >= 0 && row < rows && col >= 0 && col < cols ? row * cols + col : -1;
  }
};

}  // namespace gelflow::perception
