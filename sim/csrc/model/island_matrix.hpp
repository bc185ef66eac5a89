// Islands: sets of kinematic trees without coupling between them at the present state. Matrices over the dofs have one
// dense block per island. solver/islands.hpp finds the islands.
#pragma once

#include <algorithm>
#include <vector>

#include "math/spatial.hpp"
#include "model/model.hpp"

namespace gelflow {

struct Island {
  int size = 0;              // dofs
  int first = 0;             // dofs of the islands before it
  int stride = 0;            // of the rows of its block, with padding
  std::ptrdiff_t begin = 0;  // of its block in a matrix
  int range_begin = 0, range_end = 0;
};

// The islands and where matrices store their entries. The dofs of an island keep their order. Models whose dofs always
// form one system (Model::has_islands) have one island, whose block is the whole matrix.
class IslandLayout {
 public:
  // `padding`: of rows, the width of the packs that are added at any column.
  IslandLayout(const Model& m, int padding)
      : padding_(padding),
        dof_island_(m.nv),
        column_(m.nv),
        row_(m.nv),
        tree_row_(m.nv),
        root_(m.trees.size()),
        local_(m.trees.size()) {
    separate(m);
    for (std::size_t t = 1; t < root_.size() && !m.has_islands; ++t) join(0, static_cast<int>(t));
    apply(m);
  }
  // Matrices refer to the arrays of the layout. These stay where they are when it is moved.
  IslandLayout(const IslandLayout&) = delete;
  IslandLayout(IslandLayout&&) = default;

  // A new layout: `separate`, `join` the trees that forces couple, `apply`.
  void separate(const Model& m) {
    for (std::size_t t = 0; t < root_.size(); ++t) root_[t] = static_cast<int>(t);
    for (const auto& [first, second] : m.coupled_trees) join(first, second);
  }
  void join(int first, int second) {
    const int a = root_of(first), b = root_of(second);
    root_[std::max(a, b)] = std::min(a, b);
  }
  // Returns whether the islands differ from the previous ones.
  bool apply(const Model& m) {
    next_.resize(root_.size());
    int count = 0;
    for (std::size_t t = 0; t < root_.size(); ++t) {  // the root of a set is its first tree
      const int root = root_of(static_cast<int>(t));
      next_[t] = root == static_cast<int>(t) ? count++ : next_[root];
    }
    if (next_ == tree_island_) return false;
    tree_island_ = next_;
    set_blocks(m, count);
    set_ranges(m);
    set_entries(m);
    return true;
  }

  const std::vector<Island>& islands() const { return islands_; }
  const Island& island_of(int dof) const { return islands_[dof_island_[dof]]; }
  bool share_island(int first_tree, int second_tree) const {
    return tree_island_[first_tree] == tree_island_[second_tree];
  }
  std::ptrdiff_t entries() const { return entries_; }  // of a matrix, with padding
  // Row i begins at row()[i], and the entry of column j is at row()[i] + column()[j]; for dofs of one tree also at
  // tree_row()[i] + j.
  const std::ptrdiff_t* row() const { return row_.data(); }
  const std::ptrdiff_t* tree_row() const { return tree_row_.data(); }
  const int* column() const { return column_.data(); }
  // Calls visit(begin, size, offset) for the ranges of consecutive dofs of an island; `offset`: of the range in its block.
  template <class Visit>
  void for_ranges(const Island& island, Visit&& visit) const {
    for (int r = island.range_begin, offset = 0; r < island.range_end; ++r) {
      const int size = ranges_[r].end - ranges_[r].begin;
      visit(ranges_[r].begin, size, offset);
      offset += size;
    }
  }
  template <class Visit>
  void for_dofs(const Island& island, Visit&& visit) const {
    for_ranges(island, [&](int begin, int size, int) {
      for (int k = begin; k < begin + size; ++k) visit(k);
    });
  }
  // The first dof of an island whose dofs are consecutive, else −1.
  int consecutive_from(const Island& island) const {
    return island.range_end - island.range_begin == 1 ? ranges_[island.range_begin].begin : -1;
  }

 private:
  int root_of(int tree) {
    while (root_[tree] != tree) tree = root_[tree] = root_[root_[tree]];
    return tree;
  }
  void set_blocks(const Model& m, int count) {
    islands_.assign(count, Island{});
    for (std::size_t t = 0; t < m.trees.size(); ++t) {
      Island& island = islands_[tree_island_[t]];
      local_[t] = island.size;
      island.size += m.trees[t].end - m.trees[t].begin;
      ++island.range_end;  // the number of trees
    }
    entries_ = 0;
    int dofs = 0, ranges = 0;
    for (Island& island : islands_) {
      island.first = dofs;
      island.begin = entries_;
      island.stride = island.size + padding_;
      island.range_begin = ranges;
      dofs += island.size;
      ranges += island.range_end;
      entries_ += static_cast<std::ptrdiff_t>(island.size) * island.stride;
      island.range_end = island.range_begin;
    }
    ranges_.resize(ranges);
  }
  // The ranges of dofs of each island; trees that follow each other form one range.
  void set_ranges(const Model& m) {
    for (std::size_t t = 0; t < m.trees.size(); ++t) {
      Island& island = islands_[tree_island_[t]];
      const bool continues =
          island.range_end > island.range_begin && ranges_[island.range_end - 1].end == m.trees[t].begin;
      if (continues) {
        ranges_[island.range_end - 1].end = m.trees[t].end;
      } else {
        ranges_[island.range_end++] = m.trees[t];
      }
    }
  }
  void set_entries(const Model& m) {
    for (std::size_t t = 0; t < m.trees.size(); ++t) {
      const Island& island = islands_[tree_island_[t]];
      const int shift = local_[t] - m.trees[t].begin;
      for (int k = m.trees[t].begin; k < m.trees[t].end; ++k) {
        dof_island_[k] = tree_island_[t];
        column_[k] = k + shift;
        row_[k] = island.begin + static_cast<std::ptrdiff_t>(column_[k]) * island.stride;
        tree_row_[k] = row_[k] + shift;
      }
    }
  }

  int padding_;
  std::vector<Island> islands_;
  std::vector<DofRange> ranges_;  // by island
  std::vector<int> tree_island_, dof_island_, column_;
  std::vector<std::ptrdiff_t> row_, tree_row_;
  std::ptrdiff_t entries_ = 0;
  std::vector<int> root_, local_, next_;  // per tree: in its set, first column, next island
};

// A square matrix over the dofs without entries between islands.
template <class T>
class IslandMatrix {
 public:
  using Rows = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  using Block = Eigen::Map<Rows, Eigen::Unaligned, Eigen::OuterStride<>>;
  using ConstBlock = Eigen::Map<const Rows, Eigen::Unaligned, Eigen::OuterStride<>>;

  explicit IslandMatrix(const IslandLayout& layout)
      : row_(layout.row()), tree_row_(layout.tree_row()), column_(layout.column()) {
    fit(layout);
    set_zero();
  }
  // Sets the size after a change of the islands. The values become undefined.
  void fit(const IslandLayout& layout) {
    entries_ = layout.entries();
    if (values_.size() < entries_) values_.resize(entries_);
  }
  void set_zero() { values().setZero(); }

  // The entry of two dofs of one island.
  T& operator()(int i, int j) { return values_[row_[i] + column_[j]]; }
  const T& operator()(int i, int j) const { return values_[row_[i] + column_[j]]; }
  // The same for two dofs of one tree.
  T& in_tree(int i, int j) { return values_[tree_row_[i] + j]; }
  const T& in_tree(int i, int j) const { return values_[tree_row_[i] + j]; }
  // The 3 × `columns` block from row i and column j on, of one tree.
  template <int columns>
  auto block_in_tree(int i, int j) {
    using Small = Eigen::Matrix<T, 3, columns, columns == 1 ? Eigen::ColMajor : Eigen::RowMajor>;
    const std::ptrdiff_t stride = row_[i + 1] - row_[i];
    if constexpr (columns == 1) {
      return Eigen::Map<Small, Eigen::Unaligned, Eigen::InnerStride<>>(&in_tree(i, j), Eigen::InnerStride<>(stride));
    } else {
      return Eigen::Map<Small, Eigen::Unaligned, Eigen::OuterStride<>>(&in_tree(i, j), Eigen::OuterStride<>(stride));
    }
  }
  Block block(const Island& island) {
    return Block(values_.data() + island.begin, island.size, island.size, Eigen::OuterStride<>(island.stride));
  }
  ConstBlock block(const Island& island) const {
    return ConstBlock(values_.data() + island.begin, island.size, island.size, Eigen::OuterStride<>(island.stride));
  }
  // All entries with their padding.
  Eigen::Map<VX<T>, Eigen::AlignedMax> values() {
    return Eigen::Map<VX<T>, Eigen::AlignedMax>(values_.data(), entries_);
  }
  T* data() { return values_.data(); }

 private:
  const std::ptrdiff_t *row_, *tree_row_;  // of the layout
  const int* column_;
  Eigen::Index entries_ = 0;
  VX<T> values_;
};

}  // namespace gelflow
