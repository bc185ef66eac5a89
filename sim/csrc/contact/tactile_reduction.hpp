// Linear functions of the marker forces of a scene: y = W f, with f the readings (markers × 3) as one vector.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <vector>

namespace gelflow {

// W is stored by columns, each without the zeros before its first and after its last row: rows that concern one pad
// cost nothing at the markers of the others. Sums are in double precision and in the order of the markers.
class TactileReduction {
 public:
  // `matrix`: (rows, markers, 3), C-contiguous.
  TactileReduction(int rows, int markers, const double* matrix) : rows_(rows), markers_(markers) {
    const int count = 3 * markers;
    for (int c = 0; c < count; ++c) {
      const auto entry = [&](int row) { return matrix[static_cast<std::ptrdiff_t>(row) * count + c]; };
      int begin = 0, end = rows;
      while (begin < end && entry(begin) == 0) ++begin;
      while (end > begin && entry(end - 1) == 0) --end;
      columns_.push_back({begin, end, static_cast<std::ptrdiff_t>(values_.size())});
      for (int row = begin; row < end; ++row) values_.push_back(entry(row));
    }
  }
  int rows() const { return rows_; }
  int markers() const { return markers_; }

  // reduced = W forces. `sums`: memory for the rows.
  template <class T>
  void apply(const T* forces, std::vector<double>& sums, T* reduced) const {
    sums.assign(rows_, 0.0);
    for (std::size_t c = 0; c < columns_.size(); ++c) {
      const double force = forces[c];
      if (force == 0) continue;  // most markers are not in contact
      const Column& column = columns_[c];
      const double* value = values_.data() + column.first;
      for (int row = column.begin; row < column.end; ++row) sums[row] += force * *value++;
    }
    for (int row = 0; row < rows_; ++row) reduced[row] = T(sums[row]);
  }
  // grad_forces = Wᵀ grad_reduced.
  template <class T>
  void apply_vjp(const T* grad_reduced, T* grad_forces) const {
    for (std::size_t c = 0; c < columns_.size(); ++c) {
      const Column& column = columns_[c];
      const double* value = values_.data() + column.first;
      double sum = 0;
      for (int row = column.begin; row < column.end; ++row) sum += static_cast<double>(grad_reduced[row]) * *value++;
      grad_forces[c] = T(sum);
    }
  }

 private:
  struct Column {
    int begin, end;        // its rows
    std::ptrdiff_t first;  // of its values
  };
  int rows_, markers_;
  std::vector<Column> columns_;
  std::vector<double> values_;
};

}  // namespace gelflow
