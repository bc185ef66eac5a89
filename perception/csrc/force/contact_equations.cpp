// The equations of one step of the fit: see contact_fit.hpp.
#include "../clones.hpp"
#include "contact_fit.hpp"

namespace gelflow::perception {

namespace {

constexpr double correlation_nugget = 0.01;         // uncorrelated share of the remainder
constexpr double remainder_cutoff = 0.05;           // of the largest deviation: no remainder below it
constexpr double load_prior = 0.003 * 16;           // weight of S, relative to the largest loads
constexpr double largest_change = 0.3;              // of a in one step
constexpr double rigid_prior[3] = {1.0, 1.0, 4.0};  // precision of a and ω: deviations of 1 and 0.5 per pitch
constexpr int quantities = 7;                       // a (2), ω; the sums of the loads: shear x, y, normal, moment

}  // namespace

// out += G (the loads of one cell)
GELFLOW_CLONES inline void add_response(GramRows rows, double shear_x, double shear_y, double normal,
                                        double* __restrict out) {
  for (std::size_t i = 0; i < rows.size; ++i) out[i] += shear_x * rows.x[i] + shear_y * rows.y[i] + normal * rows.z[i];
}

// Adds what the shear of one cell adds to G T.
GELFLOW_CLONES inline void add_motion(GramRows rows, double normal, double turn_x, double turn_y,
                                      double* __restrict along, double* __restrict across, double* __restrict turn) {
  for (std::size_t i = 0; i < rows.size; ++i) {
    const double x = rows.x[i], y = rows.y[i];
    along[i] += normal * x, across[i] += normal * y, turn[i] += turn_x * x + turn_y * y;
  }
}

// Chooses the cells where the `deviation` of the remainder is not small, and those `pressed`, and factorizes the
// equations of the remainder.
void ContactFitter::set_cells(const NormalEquations& image, const Values& deviation, const std::vector<char>& pressed) {
  const double cutoff = remainder_cutoff * *std::max_element(deviation.begin(), deviation.end());
  cells_.clear();
  for (std::size_t i = 0; i < deviation.size(); ++i)
    if (deviation[i] > cutoff) cells_.push_back(int(i));
  const int k = remainder_cells_ = int(cells_.size());
  if (k == 0) throw NotPositiveDefinite("the deviation of the remainder is not a number");
  for (std::size_t i = 0; i < deviation.size(); ++i)
    if (pressed[i] && !(deviation[i] > cutoff)) cells_.push_back(int(i));
  set_precision();
  const std::size_t n = std::size_t(grid_.cells);
  const MatrixView precision = precision_.view(), equations = factor_.resize(2 * k, 2 * k);
  for (int j = 0; j < k; ++j) {
    const GramRows rows = image.rows(cell(j));
    double *column = equations.column(j), *next = equations.column(k + j) + k;
    for (int i = 0; i < k; ++i) column[k + i] = image.weight * rows.x[n + cell(i)];
    for (int i = j; i < k; ++i) {
      const double prior = precision(i, j) / (deviation[cell(i)] * deviation[cell(j)]);
      column[i] = image.weight * rows.x[cell(i)] + prior;
      next[i] = image.weight * rows.y[n + cell(i)] + prior;
    }
  }
  algebra_.factorize(equations);
}

void ContactFitter::set_precision() {
  const int k = remainder_cells_;
  if (std::equal(cells_.begin(), cells_.begin() + k, precision_cells_.begin(), precision_cells_.end())) return;
  precision_cells_.clear();
  const MatrixView correlation = correlation_.resize(k, k), inverse_factor = inverse_factor_.resize(k, k);
  std::fill_n(inverse_factor.data, k * k, 0.0);
  for (int j = 0; j < k; ++j) {
    const double* column = grid_.correlation.data() + std::size_t(grid_.cells) * cell(j);
    for (int i = j; i < k; ++i) correlation(i, j) = column[cell(i)];
    correlation(j, j) += correlation_nugget;
    inverse_factor(j, j) = 1;
  }
  algebra_.factorize(correlation);
  algebra_.solve_lower(correlation, inverse_factor);
  algebra_.square(1.0, inverse_factor, 0.0, precision_.resize(k, k));
  precision_cells_.assign(cells_.begin(), cells_.begin() + k);
}

void ContactFitter::set_ratios(const ContactFit& fit) {
  ratio_x_.clear(), ratio_y_.clear(), arm_x_.clear(), arm_y_.clear();
  for (const int i : cells_) {
    const double x = grid_.x[std::size_t(i)], y = grid_.y[std::size_t(i)];
    const auto [along, across] = fit.ratio_at(x, y);
    ratio_x_.push_back(along), ratio_y_.push_back(across);
    arm_x_.push_back(x - fit.centre[0]), arm_y_.push_back(y - fit.centre[1]);
  }
}

// p and r for the ratios of the cells; returns their cost. `scale` is that of p, and `pressed` are the cells with p > 0
// in a similar solution.
double ContactFitter::solve_loads(const NormalEquations& image, double scale, const std::vector<char>& pressed) {
  set_load_equations(image, scale);
  solver_.solve(matrix_.view(), linear_, pressed);
  const int m = int(cells_.size()), rows = 2 * remainder_cells_;
  const MatrixView cross = cross_.view();
  const double* right = cross.column(m);
  remainder_.assign(right, right + rows);
  const double cost = image.weight * image.square - dot(remainder_, remainder_) - dot(linear_, solver_.solution());
  algebra_.multiply(-1.0, cross.columns(0, m), solver_.solution().data(), 1.0, remainder_.data());
  algebra_.solve_upper(factor_.view(), {remainder_.data(), rows, 1, rows});
  return cost;
}

// W and v, M and its right side.
void ContactFitter::set_load_equations(const NormalEquations& image, double scale) {
  const int m = int(cells_.size()), k = remainder_cells_;
  const std::size_t n = std::size_t(grid_.cells), loads = 3 * n;
  const double weight = image.weight, prior = load_prior / (scale * scale);
  const Values& projected = image.projected;
  const MatrixView cross = cross_.resize(2 * k, m + 1), matrix = matrix_.resize(m, m);
  linear_.resize(std::size_t(m));
  for (int j = 0; j < m; ++j) {
    const std::size_t c = cell(j);
    const double along = ratio_x_[std::size_t(j)], across = ratio_y_[std::size_t(j)];
    row_.assign(loads, 0.0);
    add_response(image.rows(c), weight * along, weight * across, weight, row_.data());
    double* column = cross.column(j);
    for (int i = 0; i < k; ++i) column[i] = row_[cell(i)], column[k + i] = row_[n + cell(i)];
    const double* roughness = grid_.roughness.data() + n * c;
    for (int i = j; i < m; ++i) {
      const double own = row_[2 * n + cell(i)] + ratio_x_[std::size_t(i)] * row_[cell(i)] +
                         ratio_y_[std::size_t(i)] * row_[n + cell(i)];
      matrix(i, j) = own + prior * roughness[cell(i)];
    }
    linear_[std::size_t(j)] = weight * (projected[2 * n + c] + along * projected[c] + across * projected[n + c]);
  }
  double* right = cross.column(m);
  for (int i = 0; i < k; ++i) right[i] = weight * projected[cell(i)], right[k + i] = weight * projected[n + cell(i)];
  algebra_.solve_lower(factor_.view(), cross);
  algebra_.square(-1.0, cross.columns(0, m), 1.0, matrix);
  algebra_.transpose_multiply(-1.0, cross.columns(0, m), right, 1.0, linear_.data());
}

// T, and G times all loads and times T.
void ContactFitter::set_responses(const NormalEquations& image) {
  const int m = int(cells_.size()), k = remainder_cells_;
  const std::size_t loads = 3 * std::size_t(grid_.cells);
  const MatrixView shear = shear_.resize(2 * m, 3);
  std::fill_n(shear.data, 2 * m * 3, 0.0);
  for (Values* response : {&response_, &response_x_, &response_y_, &response_turn_}) response->assign(loads, 0.0);
  for (int j = 0; j < m; ++j) {
    const std::size_t s = std::size_t(j);
    const double p = solver_.solution()[s];
    shear(j, 0) = shear(m + j, 1) = p;
    shear(j, 2) = -arm_y_[s] * p, shear(m + j, 2) = arm_x_[s] * p;
    const double along = ratio_x_[s] * p + (j < k ? remainder_[s] : 0.0);
    const double across = ratio_y_[s] * p + (j < k ? remainder_[std::size_t(k + j)] : 0.0);
    const GramRows rows = image.rows(cell(j));
    add_response(rows, along, across, p, response_.data());
    if (p > 0)
      add_motion(rows, p, shear(j, 2), shear(m + j, 2), response_x_.data(), response_y_.data(), response_turn_.data());
  }
}

// The gradient of the shear loads of the cells, and the other cells where p would decrease the cost.
void ContactFitter::set_gradient(const NormalEquations& image, ContactFit& fit) {
  const std::size_t n = std::size_t(grid_.cells), m = cells_.size();
  const auto gradient = [&](std::size_t i) { return image.weight * (image.projected[i] - response_[i]); };
  gradient_.resize(2 * m);
  for (std::size_t i = 0; i < n; ++i) {
    const auto [along, across] = fit.ratio_at(grid_.x[i], grid_.y[i]);
    fit.wanted[i] = gradient(2 * n + i) + along * gradient(i) + across * gradient(n + i) > 0;
  }
  for (std::size_t j = 0; j < m; ++j) {
    const std::size_t i = std::size_t(cells_[j]);
    gradient_[j] = gradient(i), gradient_[m + j] = gradient(n + i);
    fit.wanted[i] = 0;
  }
}

// B from the responses.
void ContactFitter::set_couplings(const NormalEquations& image) {
  const int m = int(cells_.size());
  const std::size_t n = std::size_t(grid_.cells);
  const MatrixView coupling = coupling_.resize(3 * m, quantities);
  std::fill_n(coupling.data, 3 * m * quantities, 0.0);
  for (int j = 0; j < m; ++j) {
    for (int axis = 0; axis < 3; ++axis) {
      const std::size_t load = std::size_t(axis) * n + cell(j);
      const int row = axis * m + j;
      coupling(row, 0) = image.weight * response_x_[load], coupling(row, 1) = image.weight * response_y_[load];
      coupling(row, 2) = image.weight * response_turn_[load];
      coupling(row, 3 + axis) = 1;
    }
    coupling(j, 6) = -arm_y_[std::size_t(j)], coupling(m + j, 6) = arm_x_[std::size_t(j)];
  }
}

// Eliminates r, then p > 0.
void ContactFitter::eliminate_loads() {
  const int m = int(cells_.size()), k = remainder_cells_;
  const MatrixView coupling = coupling_.view(), explained = explained_.resize(quantities, quantities);
  const MatrixView of_remainder = of_remainder_.resize(2 * k, quantities);
  const MatrixView of_normal = of_normal_.resize(m, quantities);
  for (int q = 0; q < quantities; ++q) {
    const double *x = coupling.column(q), *y = x + m, *z = y + m;
    std::copy_n(x, k, of_remainder.column(q));
    std::copy_n(y, k, of_remainder.column(q) + k);
    for (int j = 0; j < m; ++j)
      of_normal(j, q) = z[j] + ratio_x_[std::size_t(j)] * x[j] + ratio_y_[std::size_t(j)] * y[j];
  }
  algebra_.solve_lower(factor_.view(), of_remainder);
  algebra_.transpose_multiply(1.0, of_remainder, of_remainder, 0.0, explained);
  algebra_.transpose_multiply(-1.0, cross_.view().columns(0, m), of_remainder, 1.0, of_normal);
  const std::vector<int>& positive = solver_.positive();
  const MatrixView of_positive = of_positive_.resize(int(positive.size()), quantities);
  if (positive.empty()) return;
  for (int q = 0; q < quantities; ++q)
    for (int i = 0; i < of_positive.rows; ++i) of_positive(i, q) = of_normal(positive[std::size_t(i)], q);
  algebra_.solve_lower(solver_.factor(), of_positive);
  algebra_.transpose_multiply(1.0, of_positive, of_positive, 1.0, explained);
}

// Solves the equations of a and ω that remain, and changes the fit by the step.
void ContactFitter::solve_rigid(ContactFit& fit) {
  const MatrixView shear = shear_.view(), explained = explained_.view(), of_rigid = of_rigid_.resize(3, quantities);
  algebra_.transpose_multiply(1.0, shear, coupling_.view().top(shear.rows), 0.0, of_rigid);
  std::array<double, 9> matrix;
  std::array<double, 15> right{};  // the slope, and the sums of the loads
  const MatrixView equations{matrix.data(), 3, 3, 3}, solved{right.data(), 3, 5, 3};
  algebra_.transpose_multiply(1.0, shear, gradient_.data(), 0.0, solved.column(0));
  const double rigid[3] = {fit.ratio[0], fit.ratio[1], fit.twist};
  for (int i = 0; i < 3; ++i) {
    for (int q = 0; q < 3; ++q) equations(i, q) = of_rigid(i, q) - explained(i, q);
    for (int q = 3; q < quantities; ++q) solved(i, q - 2) = of_rigid(i, q) - explained(i, q);
    equations(i, i) += rigid_prior[i];
    solved(i, 0) -= rigid_prior[i] * rigid[i];
  }
  algebra_.factorize(equations);
  algebra_.solve_lower(equations, solved);
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) {
      double& entry = fit.rigid_covariance[std::size_t(4 * i + j)] = explained(3 + i, 3 + j);
      for (int row = 0; row < 3; ++row) entry += solved(row, 1 + i) * solved(row, 1 + j);
    }
  algebra_.solve_upper(equations, solved.columns(0, 1));
  const double share = std::min(1.0, largest_change / std::max(std::hypot(solved(0, 0), solved(1, 0)), 1e-30));
  for (int i = 0; i < 3; ++i) solved(i, 0) *= share;
  fit.ratio[0] += solved(0, 0), fit.ratio[1] += solved(1, 0), fit.twist += solved(2, 0);
  change_loads(solved.column(0), fit);
}

// Changes p and r so that they are best for a and ω changed by `step`.
void ContactFitter::change_loads(double* step, ContactFit& fit) {
  const int m = int(cells_.size()), k = remainder_cells_;
  const std::size_t n = std::size_t(grid_.cells);
  const MatrixView of_positive = of_positive_.view().columns(0, 3);
  const std::vector<int>& positive = solver_.positive();
  Values& normal = solver_.solution();
  change_.assign(std::size_t(m), 0.0);
  if (!positive.empty()) {
    positive_change_.assign(positive.size(), 0.0);
    algebra_.multiply(-1.0, of_positive, step, 0.0, positive_change_.data());
    algebra_.solve_upper(solver_.factor(), {positive_change_.data(), of_positive.rows, 1, of_positive.rows});
    for (std::size_t i = 0; i < positive.size(); ++i) change_[std::size_t(positive[i])] = positive_change_[i];
  }
  remainder_change_.assign(std::size_t(2 * k), 0.0);
  algebra_.multiply(-1.0, of_remainder_.view().columns(0, 3), step, 0.0, remainder_change_.data());
  algebra_.multiply(-1.0, cross_.view().columns(0, m), change_.data(), 1.0, remainder_change_.data());
  algebra_.solve_upper(factor_.view(), {remainder_change_.data(), 2 * k, 1, 2 * k});
  fit.normal.assign(n, 0.0), fit.remainder.assign(2 * n, 0.0);
  for (std::size_t j = 0; j < cells_.size(); ++j) {
    const std::size_t i = std::size_t(cells_[j]), s = std::size_t(k);
    fit.normal[i] = std::max(normal[j] + change_[j], 0.0);
    if (j >= s) continue;
    fit.remainder[i] = remainder_[j] + remainder_change_[j];
    fit.remainder[n + i] = remainder_[s + j] + remainder_change_[s + j];
  }
}

// The share of the displacements that the loads do not explain, rms: |u − C t|² = |u|² − 2 tᵀ Cᵀu + tᵀ G t.
double ContactFitter::unexplained(const NormalEquations& image, const ContactFit& fit) {
  const std::size_t n = std::size_t(grid_.cells);
  response_.assign(3 * n, 0.0);
  for (const int cell : cells_) {
    const std::size_t i = std::size_t(cell);
    const auto [along, across] = fit.shear_at(i, grid_.x[i], grid_.y[i]);
    add_response(image.rows(i), along, across, fit.normal[i], response_.data());
  }
  double change = 0;
  for (const int cell : cells_) {
    const std::size_t i = std::size_t(cell);
    const auto [along, across] = fit.shear_at(i, grid_.x[i], grid_.y[i]);
    const auto of_load = [&](std::size_t load) { return response_[load] - 2 * image.projected[load]; };
    change += along * of_load(i) + across * of_load(n + i) + fit.normal[i] * of_load(2 * n + i);
  }
  return std::sqrt(std::max(image.square + change, 0.0) / image.square);
}

}  // namespace gelflow::perception
