// A cloud of contact points or markers in spatial order, with bounding spheres for the broad phase.
#pragma once

#include <vector>

#include "math/spatial.hpp"

namespace gelflow {

// Points in spatial order with two levels of blocks. Each block has a bounding sphere; the broad phase skips a block
// whose sphere does not reach the shape. Coordinates are stored as structure of arrays with `padding` zeros at the end,
// so that SIMD packs can be loaded anywhere.
struct PointCloud {
  static constexpr int padding = 8, brute_force_size = 8;
  struct Coordinates {
    std::vector<double> x, y, z;
    void add(const V3<double>& p);
    void pad();
    V3<double> operator[](int i) const { return {x[i], y[i], z[i]}; }
  };
  struct Blocks {
    Coordinates center;
    std::vector<double> radius;
    std::vector<int> begin, end;  // points (of leaves) or leaves (of groups)
    int count() const { return static_cast<int>(begin.size()); }
  };
  Coordinates points;             // sorted
  std::vector<double> weights;    // sorted
  std::vector<V3<double>> areas;  // sorted; normal components of the areas, empty if weights are not areas
  std::vector<int> original;      // index in the scene of each sorted point
  Blocks leaves, groups;
  double extent = 0;   // distance of the farthest point from the origin of the body's frame [m]
  double spacing = 0;  // between neighbours, about [m]

  PointCloud() = default;
  PointCloud(const std::vector<V3<double>>& points, const std::vector<double>& weights);
  int size() const { return static_cast<int>(original.size()); }

  // Single-precision copies of the coordinates and weights, for loops that read all points.
  struct Rounded {
    std::vector<float> x, y, z, weights;
  } rounded;
};

}  // namespace gelflow
