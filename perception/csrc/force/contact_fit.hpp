// Steps of the fit of contact loads to the displacements of the markers; contact_fit.py describes the fit.
//
// The normal loads p and the remainder r of the shear minimize, for a field A of the ratios of shear to normal load,
//
//   w |u − C t|² + rᵀ P r + pᵀ S p,   t = (A p + r, p),   p ≥ 0,
//
// with the compliance C, the measured displacements u, their weight w (1 / variance), the precision P of the remainder,
// and a matrix S that penalizes differences between neighbouring normal loads. An image enters through G = CᵀC, Cᵀu and
// |u|² only. The index r means: of the loads of the remainder; p: of the unit normal loads with their shear, (A_j, 1)
// at cell j. With the Cholesky factor L of w G_rr + P,
//
//   W = L⁻¹ w G_rp,   v = L⁻¹ w (Cᵀu)_r,   M = w G_pp + S − WᵀW,
//   M p = w (Cᵀu)_p − Wᵀv where p > 0,   Lᵀ r = v − W p.
//
// A is that of a rigid motion with the ratio a and the twist ω, which then change by a step of Gauss-Newton with p > 0
// and r free. T are the shear loads per unit of a and ω, K is the prior precision of a and ω, and E adds up the loads:
// shear x, y, normal, moment. B = (w G T, E) is eliminated with L and the factor F of M where p > 0:
//
//   R = L⁻¹ B_r,   N = F⁻¹ (B_p − WᵀR),   D = RᵀR + NᵀN,   Q = Tᵀ B − (D_T, D_TE).
//
// (a, ω) changes by (Q_T + K)⁻¹ (w Tᵀ(Cᵀu − G t) − K (a, ω)); the covariance of the sums is D_E + Q_Eᵀ (Q_T + K)⁻¹ Q_E.
#pragma once

#include <array>
#include <numeric>

#include "nonnegative.hpp"

namespace gelflow::perception {

using Values = std::vector<double>;

inline double sum(const Values& a) { return std::accumulate(a.begin(), a.end(), 0.0); }
inline double dot(const Values& a, const Values& b) { return std::inner_product(a.begin(), a.end(), b.begin(), 0.0); }

constexpr double smallest_load = 0.03;    // scale of the load of a cell where nothing is known
constexpr double remainder_share = 0.15;  // r relative to the shear of the rigid motion
constexpr double remainder_floor = 0.06;

struct LayerGrid {
  int cells;           // n
  Values x, y;         // positions [pitches]
  Values compliance;   // C, (2n, 3n)
  Values correlation;  // of the remainder, (n, n)
  Values smoothing;    // weights of a local mean, (n, n)
  Values roughness;    // S without its weight, (n, n)
};

// The rows of G of the loads on one cell.
struct GramRows {
  const double *x, *y, *z;
  std::size_t size;
};

struct NormalEquations {
  const double* gram;  // G, (3n, 3n), symmetric; the loads: shear x of all cells, then shear y, then normal
  Values projected;    // Cᵀu, (3n)
  double square;       // |u|²
  double weight;       // w

  GramRows rows(std::size_t cell) const {
    const std::size_t size = projected.size(), block = size / 3 * size;
    const double* x = gram + size * cell;
    return {x, x + block, x + 2 * block, size};
  }
};

struct LoadSums {
  std::array<double, 2> shear{};
  double normal = 0;
  std::array<double, 2> centre{};  // of pressure
  double moment = 0;               // of the shear about it
  double inertia = 0;              // sum of the normal loads times their squared distances from it
};

// The shear loads are (a + ω × (position − centre)) p + r.
struct ContactFit {
  std::array<double, 2> ratio{};   // a
  double twist = 0;                // ω
  std::array<double, 2> centre{};  // of pressure before the last step
  Values normal;                   // p, (n)
  Values remainder;                // r, (2n)
  LoadSums sums;
  double cost = 0;
  double unexplained = 0;                     // |u − C t| / |u|
  std::array<double, 16> rigid_covariance{};  // of the sums of the loads: shear x, y, normal, moment; (4, 4)
  std::vector<char> wanted;                   // cells outside of the contact that a normal load would improve, (n)

  std::array<double, 2> ratio_at(double x, double y) const {
    return {ratio[0] - twist * (y - centre[1]), ratio[1] + twist * (x - centre[0])};
  }
  std::array<double, 2> shear_at(std::size_t cell, double x, double y) const {
    const auto [along, across] = ratio_at(x, y);
    return {along * normal[cell] + remainder[cell], across * normal[cell] + remainder[normal.size() + cell]};
  }
};

class ContactFitter {
 public:
  ContactFitter(const LinearAlgebra& algebra, LayerGrid grid);

  const LayerGrid& grid() const { return grid_; }
  // The equations of displacements, (2n), along the rows of the grid, then along its columns.
  NormalEquations equations(const double* gram, Values displacement, double weight);
  // The fit with the lowest cost of those with one ratio everywhere and no twist. `scales` are those of p for each
  // ratio, `deviation` is that of the remainder.
  ContactFit first(const NormalEquations& image, const std::vector<std::array<double, 2>>& ratios, const Values& scales,
                   double deviation, std::array<double, 2> centre);
  // p and r for the present a and ω, then a and ω by Gauss-Newton with all of them free.
  ContactFit step(const NormalEquations& image, const ContactFit& fit);
  // The fit of the next image: one step, and a second one where the ratio of shear to normal load changes.
  ContactFit follow(const NormalEquations& image, const ContactFit& last);

 private:
  std::size_t cell(int j) const { return std::size_t(cells_[std::size_t(j)]); }
  LoadSums sum_loads(const ContactFit& fit) const;
  Values remainder_deviation(const ContactFit& fit);
  void set_cells(const NormalEquations& image, const Values& deviation, const std::vector<char>& pressed);
  void set_precision();
  void set_ratios(const ContactFit& fit);
  double solve_loads(const NormalEquations& image, double scale, const std::vector<char>& pressed);
  void set_load_equations(const NormalEquations& image, double scale);
  void set_responses(const NormalEquations& image);
  void set_gradient(const NormalEquations& image, ContactFit& fit);
  void set_couplings(const NormalEquations& image);
  void eliminate_loads();
  void solve_rigid(ContactFit& fit);
  void change_loads(double* step, ContactFit& fit);
  double unexplained(const NormalEquations& image, const ContactFit& fit);

  LinearAlgebra algebra_;
  LayerGrid grid_;
  // The m cells that may bear loads: a remainder is possible at the first k of them, p > 0 at all.
  std::vector<int> cells_, precision_cells_;
  int remainder_cells_ = 0;
  Matrix precision_;                          // inverse of the correlation of the remainder at `precision_cells_`
  Matrix correlation_, inverse_factor_;       // its Cholesky factor, and the inverse of that
  Matrix factor_;                             // L, (2k, 2k)
  Values ratio_x_, ratio_y_, arm_x_, arm_y_;  // A and position − centre of the cells
  Matrix cross_, matrix_;                     // (W, v), (2k, m + 1); M, (m, m)
  Values linear_;                             // right side of the equations of p, (m)
  NonnegativeSolver solver_;                  // of p, (m)
  Values remainder_;                          // r, (2k)
  // G times all loads, and times the shear per unit of a and ω; (3n).
  Values response_, response_x_, response_y_, response_turn_;
  Values gradient_;  // of the shear loads, (2m)
  Matrix shear_;     // T, (2m, 3)
  Matrix coupling_;  // B, (3m, 7)
  // R, (2k, 7); B_p − WᵀR, (m, 7); N; D, (7, 7); TᵀB, (3, 7)
  Matrix of_remainder_, of_normal_, of_positive_, explained_, of_rigid_;
  Values smoothed_, row_, change_, positive_change_, remainder_change_;
};

}  // namespace gelflow::perception
