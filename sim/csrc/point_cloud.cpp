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

PointCloud::Block bounding_block(const std::vector<V3<double>>& points, int begin, int end) {
  V3<double> low = points[begin], high = low;
  for (int i = begin; i < end; ++i) {
    low = low.cwiseMin(points[i]);
    high = high.cwiseMax(points[i]);
  }
  PointCloud::Block block{0.5 * (low + high), 0, begin, end};
  for (int i = begin; i < end; ++i) block.radius = std::max(block.radius, (points[i] - block.center).norm());
  block.radius *= 1 + 1e-6;  // also covers the rounding of single precision
  return block;
}

}  // namespace

PointCloud::PointCloud(const std::vector<V3<double>>& given, const std::vector<double>& given_weights) {
  const int n = static_cast<int>(given.size());
  original.resize(n);
  std::iota(original.begin(), original.end(), 0);
  sort_in_space(given, original, 0, n);
  for (const int i : original) {
    points.push_back(given[i]);
    weights.push_back(given_weights[i]);
  }
  for (int begin = 0; begin < n; begin += leaf_size) {
    leaves.push_back(bounding_block(points, begin, std::min(begin + leaf_size, n)));
  }
  const int leaf_count = static_cast<int>(leaves.size());
  for (int begin = 0; begin < leaf_count; begin += leaves_per_group) {
    const int end = std::min(begin + leaves_per_group, leaf_count);
    Block group = bounding_block(points, leaves[begin].begin, leaves[end - 1].end);
    group.begin = begin;
    group.end = end;
    groups.push_back(group);
  }
}

}  // namespace gelflow
