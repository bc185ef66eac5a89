#include "contact_fit.hpp"

#include <functional>

namespace gelflow::perception {

namespace {

constexpr double converged = 0.05;  // change of the ratios, below which no further step follows

// The fit with all of its shear and moment in the rigid motion. A remainder that carries a part of these sums would
// keep it in the next step: in a contact that begins to slip the normal force would decrease by up to a half.
ContactFit gather(const ContactFit& fit) {
  const LoadSums& sums = fit.sums;
  if (!(sums.normal > 0)) return fit;
  ContactFit gathered = fit;
  gathered.ratio = {sums.shear[0] / sums.normal, sums.shear[1] / sums.normal};
  gathered.twist = sums.moment / std::max(sums.inertia, 1e-9);
  gathered.centre = sums.centre;
  return gathered;
}

// Change of the ratios of shear to normal load in a step, rms over the normal load before it.
double ratio_change(const ContactFit& before, const ContactFit& after) {
  const double square_radius = before.sums.inertia / std::max(before.sums.normal, 1e-30);
  const double x = after.ratio[0] - before.ratio[0], y = after.ratio[1] - before.ratio[1];
  const double twist = after.twist - before.twist;
  return std::sqrt(x * x + y * y + square_radius * twist * twist);
}

// Mean of the ten largest loads.
double load_scale(Values normal) {
  const std::size_t count = std::min<std::size_t>(10, normal.size());
  std::partial_sort(normal.begin(), normal.begin() + std::ptrdiff_t(count), normal.end(), std::greater<>());
  return std::max(std::accumulate(normal.begin(), normal.begin() + std::ptrdiff_t(count), 0.0) / double(count),
                  smallest_load);
}

}  // namespace

ContactFitter::ContactFitter(const LinearAlgebra& algebra, LayerGrid grid)
    : algebra_(algebra), grid_(std::move(grid)), solver_(algebra) {}

NormalEquations ContactFitter::equations(const double* gram, Values displacement, double weight) {
  const int loads = 3 * grid_.cells;
  Values projected(std::size_t(loads), 0.0);
  // Row-major, so the transpose is column-major.
  const MatrixView transposed{grid_.compliance.data(), loads, 2 * grid_.cells, loads};
  algebra_.multiply(1.0, transposed, displacement.data(), 0.0, projected.data());
  return {gram, std::move(projected), dot(displacement, displacement), weight};
}

ContactFit ContactFitter::first(const NormalEquations& image, const std::vector<std::array<double, 2>>& ratios,
                                const Values& scales, double deviation, std::array<double, 2> centre) {
  const std::size_t n = std::size_t(grid_.cells);
  ContactFit best;
  best.centre = centre, best.remainder.assign(2 * n, 0.0), best.wanted.assign(n, 1);
  set_cells(image, Values(n, deviation), std::vector<char>(n, 1));
  const std::vector<char> none(n, 0);
  for (std::size_t i = 0; i < ratios.size(); ++i) {
    ContactFit trial = best;
    trial.ratio = ratios[i];
    set_ratios(trial);
    trial.cost = solve_loads(image, scales[i], none);
    trial.normal = solver_.solution();
    if (best.normal.empty() || trial.cost < best.cost) best = std::move(trial);
  }
  best.sums = sum_loads(best);
  return best;
}

ContactFit ContactFitter::step(const NormalEquations& image, const ContactFit& fit) {
  ContactFit next = fit;
  next.ratio = fit.ratio_at(fit.sums.centre[0], fit.sums.centre[1]);
  next.centre = fit.sums.centre;
  std::vector<char> pressed = next.wanted;
  for (std::size_t i = 0; i < pressed.size(); ++i) pressed[i] |= next.normal[i] > 0;
  set_cells(image, remainder_deviation(next), pressed);
  set_ratios(next);
  pressed.clear();
  for (const int i : cells_) pressed.push_back(next.normal[std::size_t(i)] > 0);
  next.cost = solve_loads(image, load_scale(next.normal), pressed);
  set_responses(image);
  set_gradient(image, next);
  set_couplings(image);
  eliminate_loads();
  solve_rigid(next);
  next.sums = sum_loads(next);
  next.unexplained = unexplained(image, next);
  return next;
}

ContactFit ContactFitter::follow(const NormalEquations& image, const ContactFit& last) {
  const ContactFit start = gather(last);
  ContactFit fit = step(image, start);
  return ratio_change(start, fit) < converged ? fit : step(image, fit);
}

LoadSums ContactFitter::sum_loads(const ContactFit& fit) const {
  LoadSums sums;
  sums.normal = sum(fit.normal), sums.centre = fit.centre;
  if (sums.normal > 0) sums.centre = {dot(fit.normal, grid_.x) / sums.normal, dot(fit.normal, grid_.y) / sums.normal};
  for (std::size_t i = 0; i < fit.normal.size(); ++i) {
    const auto [along, across] = fit.shear_at(i, grid_.x[i], grid_.y[i]);
    const double x = grid_.x[i] - sums.centre[0], y = grid_.y[i] - sums.centre[1];
    sums.shear[0] += along, sums.shear[1] += across;
    sums.moment += x * across - y * along, sums.inertia += fit.normal[i] * (x * x + y * y);
  }
  return sums;
}

// Standard deviation of the remainder, from the shear of the fit around each cell.
Values ContactFitter::remainder_deviation(const ContactFit& fit) {
  const int n = grid_.cells;
  const double largest = *std::max_element(fit.normal.begin(), fit.normal.end());
  smoothed_.resize(std::size_t(n));
  for (std::size_t i = 0; i < smoothed_.size(); ++i)
    smoothed_[i] = 0.3 * std::sqrt(fit.normal[i] * largest) + 0.7 * fit.normal[i];
  Values deviation(std::size_t(n), 0.0);
  algebra_.multiply_symmetric({grid_.smoothing.data(), n, n, n}, smoothed_.data(), 0.0, deviation.data());
  const double shear = remainder_share * (std::hypot(fit.ratio[0], fit.ratio[1]) + 1.3 * std::abs(fit.twist));
  for (double& value : deviation) value = 1.5 * value * (shear + remainder_floor) + 1e-6;
  return deviation;
}

}  // namespace gelflow::perception
