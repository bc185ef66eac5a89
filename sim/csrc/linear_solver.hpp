// A few dense linear equations: Gauss's elimination with row pivots, a pack of columns at a time.
#pragma once

#include <utility>
#include <vector>

#include "lanes.hpp"

namespace gelflow {

// Replaces the first n columns of `a` by the factors of P A = L U; on the diagonal stands 1/U. Rows of `a` are longer
// than n by a pack or more. Where A is singular, what `solve` finds is not finite.
template <class T, class Rows>
void factorize(Rows& a, int n, std::vector<int>& pivots) {
  using L = Pack<T>;
  using std::abs;
  const std::ptrdiff_t stride = a.outerStride();
  T* const start = a.data();
  for (int k = 0; k < n; ++k) {
    T* const pivot_row = start + k * stride;
    int largest = k;
    for (int i = k + 1; i < n; ++i) {
      if (abs(start[i * stride + k]) > abs(start[largest * stride + k])) largest = i;
    }
    pivots[k] = largest;
    if (largest != k) std::swap_ranges(pivot_row, pivot_row + n, start + largest * stride);
    pivot_row[k] = T(1) / pivot_row[k];
    for (int i = k + 1; i < n; ++i) {
      T* const row = start + i * stride;
      row[k] *= pivot_row[k];
      const L factor(row[k]);
      for (int j = k + 1; j < n; j += pack_width<T>) {
        store(load<L>(row + j) - factor * load<L>(pivot_row + j), row + j);
      }
    }
  }
}

// x = A⁻¹ b, from what `factorize` left.
template <class T, class Rows>
void solve(const Rows& a, int n, const std::vector<int>& pivots, const VX<T>& b, VX<T>& x) {
  const std::ptrdiff_t stride = a.outerStride();
  const T* const start = a.data();
  x = b;
  for (int k = 0; k < n; ++k) std::swap(x[k], x[pivots[k]]);
  for (int j = 0; j < n; ++j) {
    for (int i = j + 1; i < n; ++i) x[i] -= start[i * stride + j] * x[j];
  }
  for (int i = n - 1; i >= 0; --i) {
    x[i] *= start[i * stride + i];
    for (int j = 0; j < i; ++j) x[j] -= start[j * stride + i] * x[i];
  }
}

}  // namespace gelflow
