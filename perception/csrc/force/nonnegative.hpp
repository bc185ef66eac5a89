// Least squares with variables that must not be negative, for small dense problems: the x ≥ 0 with the smallest
// ½ xᵀ H x − linearᵀ x, for a positive definite H.
//
// Block principal pivoting after Portugal, Júdice and Vicente (1994): each iteration moves all infeasible variables
// into or out of the set of positive ones, or a single one if their number no longer decreases.
#pragma once

#include <cmath>

#include "linear_algebra.hpp"

namespace gelflow::perception {

class NonnegativeSolver {
 public:
  explicit NonnegativeSolver(const LinearAlgebra& algebra) : algebra_(algebra) {}

  // `start` is the first set of positive variables, for example that of a similar problem.
  void solve(MatrixView hessian, const std::vector<double>& linear, const std::vector<char>& start) {
    const std::size_t n = linear.size();
    is_positive_ = start;
    std::size_t fewest = n + 1;
    int exchanges = full_exchanges;
    double largest = 0;
    for (const double value : linear) largest = std::max(largest, std::abs(value));
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
      solve_positive(hessian, linear);
      find_wrong(hessian, linear, 1e-9 * largest);
      if (wrong_.empty()) break;
      if (wrong_.size() < fewest) {
        fewest = wrong_.size(), exchanges = full_exchanges;
      } else if (exchanges > 0) {
        --exchanges;
      } else {
        wrong_.erase(wrong_.begin(), wrong_.end() - 1);
      }
      for (const int i : wrong_) is_positive_[std::size_t(i)] = !is_positive_[std::size_t(i)];
    }
    const std::size_t solved = positive_.size();
    std::erase_if(positive_, [&](int i) { return !(x_[std::size_t(i)] > 0); });
    for (double& value : x_) value = std::max(value, 0.0);
    if (positive_.size() != solved) factorize(hessian);
  }

  // The solution, the indices of its positive variables, and the Cholesky factor of the part of H that belongs to them.
  std::vector<double>& solution() { return x_; }
  const std::vector<int>& positive() const { return positive_; }
  MatrixView factor() { return factor_.view(); }

 private:
  static constexpr int max_iterations = 60;
  static constexpr int full_exchanges = 3;  // without progress, before variables are exchanged one by one

  void factorize(MatrixView hessian) {
    const int count = int(positive_.size());
    const MatrixView factor = factor_.resize(count, count);
    for (int j = 0; j < count; ++j) {
      const double* column = hessian.column(positive_[std::size_t(j)]);
      for (int i = j; i < count; ++i) factor(i, j) = column[positive_[std::size_t(i)]];
    }
    if (count) algebra_.factorize(factor);
  }

  // x with the present set of positive variables, the others 0.
  void solve_positive(MatrixView hessian, const std::vector<double>& linear) {
    positive_.clear(), right_.clear();
    for (std::size_t i = 0; i < linear.size(); ++i)
      if (is_positive_[i]) positive_.push_back(int(i)), right_.push_back(linear[i]);
    factorize(hessian);
    x_.assign(linear.size(), 0.0);
    if (positive_.empty()) return;
    const int count = int(positive_.size());
    const MatrixView right{right_.data(), count, 1, count};
    algebra_.solve_lower(factor_.view(), right);
    algebra_.solve_upper(factor_.view(), right);
    for (std::size_t i = 0; i < positive_.size(); ++i) x_[std::size_t(positive_[i])] = right_[i];
  }

  // The positive variables that are negative, and the others that would decrease the sum.
  void find_wrong(MatrixView hessian, const std::vector<double>& linear, double tolerance) {
    slope_ = linear;
    algebra_.multiply_symmetric(hessian, x_.data(), -1.0, slope_.data());
    wrong_.clear();
    for (std::size_t i = 0; i < linear.size(); ++i)
      if (is_positive_[i] ? x_[i] < 0 : slope_[i] < -tolerance) wrong_.push_back(int(i));
  }

  LinearAlgebra algebra_;
  std::vector<char> is_positive_;
  std::vector<int> positive_, wrong_;
  std::vector<double> x_, right_, slope_;
  Matrix factor_;
};

}  // namespace gelflow::perception
