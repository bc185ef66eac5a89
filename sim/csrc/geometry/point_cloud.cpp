// Points sorted in space, and the blocks that are skipped whole.
#include "geometry/point_cloud.hpp"

#include <algorithm>
#include <numeric>

namespace gelflow {

namespace {

constexpr int leaf_size = 8;
constexpr int leaves_per_group = 16;

// Sorts indices [begin, end) so that every run of `leaf` is compact: split the longest axis at a multiple of it.
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
  while (unit * 2 < n) unit *= 2;  // the left half is a full subtree: groups of leaves stay contiguous
  const int middle = begin + unit;
  // Ties are broken by the index, so that the order is the same with every standard library.
  std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end, [&](int a, int b) {
    const double pa = points[a][axis], pb = points[b][axis];
    return pa < pb || (pa == pb && a < b);
  });
  std::sort(order.begin() + begin, order.begin() + middle);
  std::sort(order.begin() + middle, order.begin() + end);
  sort_in_space(points, order, begin, middle, leaf);
  sort_in_space(points, order, middle, end, leaf);
}

// The middles of fours of points that follow one another in a row, as in a grid of markers; none where not all do.
std::vector<V3<double>> middles_of_fours(const std::vector<V3<double>>& points) {
  std::vector<V3<double>> middles;
  if (points.size() % 4 != 0) return middles;
  for (std::size_t i = 0; i < points.size(); i += 4) {
    const V3<double> first = points[i + 1] - points[i];
    for (int k = 2; k < 4; ++k) {
      const V3<double> next = points[i + k] - points[i + k - 1];
      if ((next - first).norm() > 0.5 * first.norm()) return {};
    }
    middles.push_back(0.5 * (points[i] + points[i + 3]));
  }
  return middles;
}

// Indices of points, sorted in space in leaves. Fours stay together, so that what belongs to them is moved at once.
std::vector<int> sorted_in_space(const std::vector<V3<double>>& points) {
  const std::vector<V3<double>> middles = middles_of_fours(points);
  std::vector<int> order(middles.empty() ? points.size() : middles.size());
  std::iota(order.begin(), order.end(), 0);
  const int count = static_cast<int>(order.size());
  if (middles.empty()) {
    sort_in_space(points, order, 0, count, leaf_size);
    return order;
  }
  sort_in_space(middles, order, 0, count, leaf_size / 4);
  std::vector<int> all;
  for (const int four : order) {
    for (int k = 0; k < 4; ++k) all.push_back(4 * four + k);
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

void PointCloud::Coordinates::add(const V3<double>& p) {
  x.push_back(p[0]);
  y.push_back(p[1]);
  z.push_back(p[2]);
}

void PointCloud::Coordinates::pad() {
  for (std::vector<double>* axis : {&x, &y, &z}) axis->resize(axis->size() + padding);
}

PointCloud::PointCloud(const std::vector<V3<double>>& given, const std::vector<double>& given_weights) {
  const int n = static_cast<int>(given.size());
  original = sorted_in_space(given);
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
  rounded = {{points.x.begin(), points.x.end()},
             {points.y.begin(), points.y.end()},
             {points.z.begin(), points.z.end()},
             {weights.begin(), weights.end()}};
  pad_blocks(leaves);
  pad_blocks(groups);
}

}  // namespace gelflow
