#include "geometry/point_cloud.hpp"

#include <algorithm>
#include <numeric>

namespace gelflow {

namespace {

constexpr int leaf_size = 8;
constexpr int leaves_per_group = 16;

// Sorts the indices [begin, end) so that every run of `leaf` points is compact: splits the longest axis recursively, at a
// multiple of `leaf`.
void sort_in_space(const std::vector<V3<double>>& points, std::vector<int>& order, int begin, int end, int leaf) {
  const int n = end - begin;
  if (n <= leaf) return;
  V3<double> low = points[order[begin]], high = low;
  for (int i = begin; i < end; ++i) {
    low = low.cwiseMin(points[order[i]]);
    high = high.cwiseMax(points[order[i]]);
  }
  int axis = 0;
  (high - low).maxCoeff(&axis);
  int unit = leaf;
  while (unit * 2 < n) unit *= 2;  // the left half is a full subtree, so groups of leaves stay contiguous
  const int middle = begin + unit;
  // Ties are broken by index, so that the order does not depend on the standard library.
  std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end, [&](int a, int b) {
    const double pa = points[a][axis], pb = points[b][axis];
    return pa < pb || (pa == pb && a < b);
  });
  std::sort(order.begin() + begin, order.begin() + middle);
  std::sort(order.begin() + middle, order.begin() + end);
  sort_in_space(points, order, begin, middle, leaf);
  sort_in_space(points, order, middle, end, leaf);
}

// Midpoints of groups of four consecutive points, if each group lies in a row like the markers of a grid; else empty.
std::vector<V3<double>> quad_midpoints(const std::vector<V3<double>>& points) {
  std::vector<V3<double>> midpoints;
  if (points.size() % 4 != 0) return midpoints;
  for (std::size_t i = 0; i < points.size(); i += 4) {
    const V3<double> first = points[i + 1] - points[i];
    for (int k = 2; k < 4; ++k) {
      const V3<double> next = points[i + k] - points[i + k - 1];
      if ((next - first).norm() > 0.5 * first.norm()) return {};
    }
    midpoints.push_back(0.5 * (points[i] + points[i + 3]));
  }
  return midpoints;
}

// Indices of the points in spatial order. Groups of four in a row stay together, so that their data is loaded and stored
// at once.
std::vector<int> sorted_in_space(const std::vector<V3<double>>& points) {
  const std::vector<V3<double>> midpoints = quad_midpoints(points);
  std::vector<int> order(midpoints.empty() ? points.size() : midpoints.size());
  std::iota(order.begin(), order.end(), 0);
  const int count = static_cast<int>(order.size());
  if (midpoints.empty()) {
    sort_in_space(points, order, 0, count, leaf_size);
    return order;
  }
  sort_in_space(midpoints, order, 0, count, leaf_size / 4);
  std::vector<int> all;
  for (const int quad : order) {
    for (int k = 0; k < 4; ++k) all.push_back(4 * quad + k);
  }
  return all;
}

struct Sphere {
  V3<double> center;
  double radius;
};
Sphere bounding_sphere(const PointCloud::Coordinates& points, int begin, int end) {
  V3<double> low = points[begin], high = low;
  for (int i = begin; i < end; ++i) {
    low = low.cwiseMin(points[i]);
    high = high.cwiseMax(points[i]);
  }
  Sphere sphere{0.5 * (low + high), 0};
  for (int i = begin; i < end; ++i) sphere.radius = std::max(sphere.radius, (points[i] - sphere.center).norm());
  sphere.radius *= 1 + 1e-6;  // covers the rounding errors of single precision
  return sphere;
}

void add_block(PointCloud::Blocks& blocks, const Sphere& sphere, int begin, int end) {
  blocks.center.add(sphere.center);
  blocks.radius.push_back(sphere.radius);
  blocks.begin.push_back(begin);
  blocks.end.push_back(end);
}

void pad_blocks(PointCloud::Blocks& blocks) {
  blocks.center.pad();
  blocks.radius.resize(blocks.radius.size() + PointCloud::padding);
}

}  // namespace

void PointCloud::Coordinates::add(const V3<double>& p) {
  x.push_back(p[0]);
  y.push_back(p[1]);
  z.push_back(p[2]);
}

void PointCloud::Coordinates::pad() {
  for (std::vector<double>* axis : {&x, &y, &z}) axis->resize(axis->size() + padding);
}

PointCloud::PointCloud(const std::vector<V3<double>>& unsorted, const std::vector<double>& unsorted_weights) {
  const int n = static_cast<int>(unsorted.size());
  original = sorted_in_space(unsorted);
  for (const int i : original) {
    points.add(unsorted[i]);
    weights.push_back(unsorted_weights[i]);
    extent = std::max(extent, unsorted[i].norm());
  }
  for (int begin = 0; begin < n; begin += leaf_size) {
    const int end = std::min(begin + leaf_size, n);
    add_block(leaves, bounding_sphere(points, begin, end), begin, end);
  }
  const int leaf_count = leaves.count();
  for (const double radius : leaves.radius) spacing += radius / (2 * leaf_count);  // a leaf has about 2 × 4 points
  for (int begin = 0; begin < leaf_count; begin += leaves_per_group) {
    const int end = std::min(begin + leaves_per_group, leaf_count);
    add_block(groups, bounding_sphere(points, leaves.begin[begin], leaves.end[end - 1]), begin, end);
  }
  points.pad();
  weights.resize(weights.size() + padding);
  rounded = {{points.x.begin(), points.x.end()},
             {points.y.begin(), points.y.end()},
             {points.z.begin(), points.z.end()},
             {weights.begin(), weights.end()}};
  pad_blocks(leaves);
  pad_blocks(groups);
}

}  // namespace gelflow
