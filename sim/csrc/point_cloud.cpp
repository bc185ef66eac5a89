// Points sorted in space, and the blocks that are skipped whole.
#include <algorithm>
#include <numeric>

#include "model.hpp"

namespace gelflow {

namespace {

constexpr int leaf_size = 8;
constexpr int leaves_per_group = 16;

// Sorts indices [begin, end) so that every run of `leaf_size` is compact: split the longest axis at a multiple of it.
void sort_in_space(const std::vector<V3<double>>& points, std::vector<int>& order, int begin, int end) {
  const int n = end - begin;
  if (n <= leaf_size) return;
  V3<double> low = points[order[begin]], high = low;
  for (int i = begin; i < end; ++i) {
    low = low.cwiseMin(points[order[i]]);
    high = high.cwiseMax(points[order[i]]);
  }
  int axis = 0;
  (high - low).maxCoeff(&axis);
  int unit = leaf_size;
  while (unit * 2 < n) unit *= 2;  // the left half is a full subtree: groups of leaves stay contiguous
  const int middle = begin + unit;
  // Ties are broken by the index, so that the order is the same with every standard library.
  std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end, [&](int a, int b) {
    const double pa = points[a][axis], pb = points[b][axis];
    return pa < pb || (pa == pb && a < b);
  });
  std::sort(order.begin() + begin, order.begin() + middle);
  std::sort(order.begin() + middle, order.begin() + end);
  sort_in_space(points, order, begin, middle);
  sort_in_space(points, order, middle, end);
}

struct Sphere {
  V3<double> center;
  double radius;
};
Sphere bounding_sphere(const PointCloud::Places& points, int begin, int end) {
  V3<double> low = points[begin], high = low;
  for (int i = begin; i < end; ++i) {
    low = low.cwiseMin(points[i]);
    high = high.cwiseMax(points[i]);
  }
  Sphere sphere{0.5 * (low + high), 0};
  for (int i = begin; i < end; ++i) sphere.radius = std::max(sphere.radius, (points[i] - sphere.center).norm());
  sphere.radius *= 1 + 1e-6;  // also covers the rounding of single precision
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

void PointCloud::Places::add(const V3<double>& p) {
  x.push_back(p[0]);
  y.push_back(p[1]);
  z.push_back(p[2]);
}

void PointCloud::Places::pad() {
  for (std::vector<double>* axis : {&x, &y, &z}) axis->resize(axis->size() + padding);
}

PointCloud::PointCloud(const std::vector<V3<double>>& given, const std::vector<double>& given_weights) {
  const int n = static_cast<int>(given.size());
  original.resize(n);
  std::iota(original.begin(), original.end(), 0);
  sort_in_space(given, original, 0, n);
  for (const int i : original) {
    points.add(given[i]);
    weights.push_back(given_weights[i]);
    extent = std::max(extent, given[i].norm());
  }
  for (int begin = 0; begin < n; begin += leaf_size) {
    const int end = std::min(begin + leaf_size, n);
    add_block(leaves, bounding_sphere(points, begin, end), begin, end);
  }
  const int leaf_count = leaves.count();
  for (const double radius : leaves.radius) spacing += radius / (2 * leaf_count);  // a leaf is 2 × 4 points, or so
  for (int begin = 0; begin < leaf_count; begin += leaves_per_group) {
    const int end = std::min(begin + leaves_per_group, leaf_count);
    add_block(groups, bounding_sphere(points, leaves.begin[begin], leaves.end[end - 1]), begin, end);
  }
  points.pad();
  weights.resize(weights.size() + padding);
  pad_blocks(leaves);
  pad_blocks(groups);
}

}  // namespace gelflow
