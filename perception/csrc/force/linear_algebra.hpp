// Dense matrices, and the routines of BLAS and LAPACK that the contact fit calls.
//
// Matrices are column-major. Of symmetric matrices and of Cholesky factors only the lower triangle is read and set.
#pragma once

#include <algorithm>
#include <cstddef>
#include <stdexcept>
#include <vector>

namespace gelflow::perception {

struct NotPositiveDefinite : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// A matrix, or a part of it, that lies elsewhere; `stride` is the distance of its columns.
struct MatrixView {
  double* data;
  int rows, cols, stride;

  double* column(int j) const { return data + std::ptrdiff_t(j) * stride; }
  double& operator()(int i, int j) const { return column(j)[i]; }
  MatrixView columns(int first, int count) const { return {column(first), rows, count, stride}; }
  MatrixView top(int count) const { return {data, count, cols, stride}; }
};

class Matrix {
 public:
  // The entries are not kept, and not set.
  MatrixView resize(int rows, int cols) {
    if (values_.size() < std::size_t(rows) * std::size_t(cols)) values_.resize(std::size_t(rows) * std::size_t(cols));
    rows_ = rows, cols_ = cols;
    return view();
  }
  MatrixView view() { return {values_.data(), rows_, cols_, std::max(rows_, 1)}; }

 private:
  std::vector<double> values_;
  int rows_ = 0, cols_ = 0;
};

// Pointers to the Fortran routines of the same names.
struct LinearAlgebra {
  using Gemm = void(char*, char*, int*, int*, int*, double*, double*, int*, double*, int*, double*, double*, int*);
  using Gemv = void(char*, int*, int*, double*, double*, int*, double*, int*, double*, double*, int*);
  using Symv = void(char*, int*, double*, double*, int*, double*, int*, double*, double*, int*);
  using Syrk = void(char*, char*, int*, int*, double*, double*, int*, double*, double*, int*);
  using Trsm = void(char*, char*, char*, char*, int*, int*, double*, double*, int*, double*, int*);
  using Potrf = void(char*, int*, double*, int*, int*);
  Gemm* dgemm;
  Gemv* dgemv;
  Symv* dsymv;
  Syrk* dsyrk;
  Trsm* dtrsm;
  Potrf* dpotrf;

  // Replaces a symmetric matrix by its lower Cholesky factor. Throws NotPositiveDefinite.
  void factorize(MatrixView a) const {
    char lower = 'L';
    int info = 0;
    dpotrf(&lower, &a.rows, a.data, &a.stride, &info);
    if (info != 0) throw NotPositiveDefinite("the equations of the loads are not positive definite");
  }
  // b = L⁻¹ b
  void solve_lower(MatrixView factor, MatrixView b) const { solve_triangle('N', factor, b); }
  // b = L⁻ᵀ b
  void solve_upper(MatrixView factor, MatrixView b) const { solve_triangle('T', factor, b); }
  // c = α aᵀ b + β c
  void transpose_multiply(double alpha, MatrixView a, MatrixView b, double beta, MatrixView c) const {
    char transposed = 'T', plain = 'N';
    dgemm(&transposed, &plain, &c.rows, &c.cols, &a.rows, &alpha, a.data, &a.stride, b.data, &b.stride, &beta, c.data,
          &c.stride);
  }
  // c = α aᵀ a + β c, for a symmetric c
  void square(double alpha, MatrixView a, double beta, MatrixView c) const {
    char lower = 'L', transposed = 'T';
    dsyrk(&lower, &transposed, &c.rows, &a.rows, &alpha, a.data, &a.stride, &beta, c.data, &c.stride);
  }
  // y = α a x + β y
  void multiply(double alpha, MatrixView a, double* x, double beta, double* y) const {
    gemv('N', alpha, a, x, beta, y);
  }
  // y = α aᵀ x + β y
  void transpose_multiply(double alpha, MatrixView a, double* x, double beta, double* y) const {
    gemv('T', alpha, a, x, beta, y);
  }
  // y = a x + β y, for a symmetric a
  void multiply_symmetric(MatrixView a, double* x, double beta, double* y) const {
    char lower = 'L';
    double one = 1;
    int step = 1;
    dsymv(&lower, &a.rows, &one, a.data, &a.stride, x, &step, &beta, y, &step);
  }

 private:
  void solve_triangle(char form, MatrixView factor, MatrixView b) const {
    char left = 'L', lower = 'L', diagonal = 'N';
    double one = 1;
    dtrsm(&left, &lower, &form, &diagonal, &b.rows, &b.cols, &one, factor.data, &factor.stride, b.data, &b.stride);
  }
  void gemv(char form, double alpha, MatrixView a, double* x, double beta, double* y) const {
    int step = 1;
    dgemv(&form, &a.rows, &a.cols, &alpha, a.data, &a.stride, x, &step, &beta, y, &step);
  }
};

}  // namespace gelflow::perception
