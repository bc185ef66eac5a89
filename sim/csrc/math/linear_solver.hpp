// Small dense linear systems. Up to `max_inverse_size` equations are solved with the inverse matrix (Gauss-Jordan
// elimination): one matrix serves several right-hand sides, and a product has no chain of dependent divisions. Larger
// systems, and scalars without SIMD packs, use LU factorization. Both pivot rows and process one pack of columns at a
// time.
#pragma once

#include <utility>

#include "math/simd_pack.hpp"

namespace gelflow {

constexpr int max_inverse_size = 16;

// Partial pivoting: swaps row k with the row from k on whose entry in column k has the largest magnitude.
template <class T, class Rows>
T* pivot_row(Rows& a, int n, int k, int* pivots) {
  using std::abs;
  const std::ptrdiff_t stride = a.outerStride();
  T* const row = a.data() + k * stride;
  int largest = k;
  T magnitude = abs(row[k]);
  for (int i = k + 1; i < n; ++i) {
    const T candidate = abs(a.data()[i * stride + k]);
    const bool is_larger = candidate > magnitude;
    largest = is_larger ? i : largest;
    magnitude = is_larger ? candidate : magnitude;
  }
  pivots[k] = largest;
  if (largest != k) std::swap_ranges(row, row + n, a.data() + largest * stride);
  return row;
}

// Replaces the first n columns of `a`, stored in `packs` packs per row, by the inverse (Gauss-Jordan elimination).
template <int packs, class T, class Rows>
void invert(Rows& a, int n, int* pivots) {
  using P = Pack<T>;
  constexpr int width = pack_width<T>;
  const std::ptrdiff_t stride = a.outerStride();
  T* const start = a.data();
  P column[packs];
  for (int i = 0; i < packs * width; ++i) set_lane(column[i / width], i % width, T(i));
  for (int k = 0; k < n; ++k) {
    T* const pivot_row_k = pivot_row<T>(a, n, k, pivots);
    const P inverse(T(1) / pivot_row_k[k]);
    Mask<P> in_column[packs];  // selects column k, which becomes that of the inverse
    P pivot[packs];
    for (int p = 0; p < packs; ++p) {
      in_column[p] = !(column[p] < P(T(k))) && !(column[p] > P(T(k)));
      pivot[p] = select(in_column[p], inverse, inverse * load<P>(pivot_row_k + p * width));
      store(pivot[p], pivot_row_k + p * width);
    }
    for (int i = 0; i < n; ++i) {
      if (i == k) continue;
      T* const row = start + i * stride;
      const P factor(row[k]);
      for (int p = 0; p < packs; ++p) {
        const P old = load<P>(row + p * width);
        store(select(in_column[p], P(0.0), old) - factor * pivot[p], row + p * width);
      }
    }
  }
  for (int k = n - 1; k >= 0; --k) {
    if (pivots[k] == k) continue;
    for (int i = 0; i < n; ++i) std::swap(a(i, k), a(i, pivots[k]));
  }
}
template <class T, class Rows, int packs = 1>
void invert(Rows& a, int n, int* pivots) {
  if constexpr ((packs + 1) * pack_width<T> <= max_inverse_size) {
    if (n > packs * pack_width<T>) return invert<T, Rows, packs + 1>(a, n, pivots);
  }
  invert<packs, T>(a, n, pivots);
}

template <class T>
bool uses_inverse(int n) {
  return pack_width<T> > 1 && n <= max_inverse_size;
}

// Factorizes (or inverts) `a` in place for `solve`. Rows are padded by at least one pack. For a singular matrix `solve`
// returns values that are not finite.
template <class T, class Rows>
void factorize(Rows& a, int n, int* pivots) {
  if constexpr (pack_width<T> > 1) {
    if (uses_inverse<T>(n)) return invert<T>(a, n, pivots);
  }
  // P A = L U; the diagonal stores 1/U.
  using P = Pack<T>;
  const std::ptrdiff_t stride = a.outerStride();
  T* const start = a.data();
  for (int k = 0; k < n; ++k) {
    T* const pivot_row_k = pivot_row<T>(a, n, k, pivots);
    pivot_row_k[k] = T(1) / pivot_row_k[k];
    for (int i = k + 1; i < n; ++i) {
      T* const row = start + i * stride;
      row[k] *= pivot_row_k[k];
      const P factor(row[k]);
      for (int j = k + 1; j < n; j += pack_width<T>) {
        store(load<P>(row + j) - factor * load<P>(pivot_row_k + j), row + j);
      }
    }
  }
}

// x = A⁻¹ b, with `a` and `pivots` from `factorize`.
template <class T, class Rows>
void solve(const Rows& a, int n, const int* pivots, const T* b, T* x) {
  const std::ptrdiff_t stride = a.outerStride();
  const T* const start = a.data();
  if (uses_inverse<T>(n)) {
    using P = Pack<T>;
    constexpr int width = pack_width<T>;
    T rhs[max_inverse_size + NativePack<float>::width];
    std::copy(b, b + n, rhs);
    std::fill(rhs + n, rhs + n + width, T(0));
    for (int i = 0; i < n; i += width) {
      P sums[width];
      for (int k = 0; k < width; ++k) {
        const T* const row = start + std::min(i + k, n - 1) * stride;
        P sum = load<P>(row) * load<P>(rhs);
        for (int j = width; j < n; j += width) sum += load<P>(row + j) * load<P>(rhs + j);
        sums[k] = sum;
      }
      T products[width];
      sum_lanes(sums, width, products);
      std::copy(products, products + std::min(width, n - i), x + i);
    }
    return;
  }
  std::copy(b, b + n, x);
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
