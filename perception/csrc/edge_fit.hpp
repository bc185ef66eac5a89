// Fit of the centre of a dot by its edge, in light that changes over the dot.
//
// Under a contact, wrinkles, shadows and reflections change the brightness within a fraction of a dot. The linear
// background of dot_fit.hpp cannot follow them, and the residuals shift the centre. Near the edge, a background with more
// unknowns is still determined by the image, because the profile changes there over a much shorter distance than the
// light:
//
//   m(ρ, φ) = b (1 + Σ c_k cos kφ + d_k sin kφ) (1 + a s(ρ)),   c_k, d_k linear in ρ,
//
// in polar coordinates of the dot, with ρ = 1 on its outline, within a ring around the outline. Noise has a larger effect
// on this fit, so the tracker uses it only where the fit of dot_fit.hpp explains the edge less than at rest. The image is
// sampled at the points of a polar grid that moves with the dot, so that the Jacobian is the same for all dots and
// positions.
#pragma once

#include <numbers>

#include "dot_fit.hpp"

namespace gelflow::perception {

class EdgeFit {
 public:
  // `contrast` is that of a typical dot.
  EdgeFit(const DotProfile& profile, double contrast) : contrast_(contrast) {
    const float per_square = float(DotProfile::steps) / profile.reach;
    for (int p = 0; p < points; ++p) {
      const float radius = inner + (outer - inner) * (float(p / angles) + 0.5f) / radii;
      const double angle = 2 * std::numbers::pi * (p % angles) / angles;
      const float at = std::min(per_square * radius * radius, float(DotProfile::steps));
      const auto below = std::size_t(at);
      const float change = profile.value[below + 1] - profile.value[below];
      radius_[p] = radius, cos_[p] = float(std::cos(angle)), sin_[p] = float(std::sin(angle));
      profile_[p] = profile.value[below] + (at - float(below)) * change;
      slope_[p] = 2 * radius * per_square * change;
      for (int k = 0; k <= harmonics; ++k) {
        const int first = k == 0 ? 0 : 2 * k - 1;
        background_[first][p] = float(std::cos(k * angle));
        if (k > 0) background_[first + 1][p] = float(std::sin(k * angle));
      }
      for (int i = 0; i < terms / 2; ++i) background_[terms / 2 + i][p] = background_[i][p] * (radius - 1);
    }
    std::array<double, unknowns * unknowns> hessian{};
    for (int p = 0; p < points; ++p) {
      std::array<double, unknowns> j;
      j[0] = -contrast * slope_[p] * cos_[p], j[1] = -contrast * slope_[p] * sin_[p], j[2] = profile_[p];
      for (int i = 0; i < terms; ++i) j[3 + i] = background_[i][p] * (1 + contrast * profile_[p]);
      for (int i = 0; i < unknowns; ++i)
        for (int l = 0; l < unknowns; ++l) hessian[std::size_t(unknowns * i + l)] += j[i] * j[l];
    }
    for (int i = 4; i < unknowns; ++i) hessian[std::size_t((unknowns + 1) * i)] += prior;
    is_valid_ = invert<unknowns>(hessian, inverse_);
  }

  // Improves the fit `begin` of a dot; the other arguments are those of `fit_dot`. The quality of the result is 0 where
  // the fit diverges.
  DotFit improve(const Plane& plane, const DotShape& shape, const DotMask* mask, double noise, double tolerated,
                 const DotFit& begin) const {
    if (!is_valid_) return {begin.position, begin.contrast, 0};
    Samples samples;
    place_points(shape, mask, samples);
    std::array<double, terms> light{};
    float x = float(begin.position.x), y = float(begin.position.y), a = float(begin.contrast);
    Sums sums;
    for (int number = 0; number < max_iterations; ++number) {
      sample(plane, x, y, samples);
      if (number == 0) light[0] = brightness(samples);
      const float b = float(std::max(light[0], 1.0));
      const float k = b * scale_factor * float(std::max(tolerated * std::abs(double(a)), 3 * noise));
      accumulate(samples, light, a, k, sums);
      for (int i = 1; i < terms; ++i) sums.gradient[std::size_t(3 + i)] -= prior * light[std::size_t(i)] / b;
      const double scale = std::min(4.0, sums.mask / std::max(sums.weight, 1.0));
      std::array<double, unknowns> step{};
      for (std::size_t i = 0; i < unknowns; ++i)
        for (std::size_t l = 0; l < unknowns; ++l) step[i] += scale * inverse_[unknowns * i + l] * sums.gradient[l];
      // The step of the centre is in the frame of the dot.
      const float u = float(std::clamp(step[0], -largest_step, largest_step));
      const float v = float(std::clamp(step[1], -largest_step, largest_step));
      const auto [right, down] = to_image(shape, u, v);
      x += right, y += down, a += float(std::clamp(step[2], -0.1, 0.1));
      for (std::size_t i = 0; i < terms; ++i) light[i] += b * step[3 + i];
      if (!(a * begin.contrast > 0) || !std::isfinite(x + y)) return {begin.position, begin.contrast, 0};
      if (std::max(std::abs(right), std::abs(down)) < float(tolerance)) break;
    }
    return {{x, y}, a, std::clamp(sums.edge_weighted / std::max(sums.edge, 1e-9), 0.0, 1.0)};
  }

 private:
  static constexpr int radii = 10, angles = 32, points = radii * angles, harmonics = 2;
  static constexpr int terms = 2 * (2 * harmonics + 1), unknowns = 3 + terms, max_iterations = 12;
  static constexpr float inner = 0.4f, outer = 1.7f;  // of the ring
  static constexpr double prior = 0.01 * points;      // weight of the squares of c_k and d_k
  static constexpr float scale_factor = 1.5f;         // of the robust weight, relative to `fit_dot`
  static constexpr double largest_step = 0.3;         // of the centre [radii]

  using Values = std::array<float, points>;

  struct Samples {
    alignas(32) Values right, down;    // from the centre [px]
    alignas(32) Values mask;           // weight of the points by `DotMask`
    alignas(32) Values pixel, inside;  // grey levels, and the mask of the points inside the image
  };
  struct Sums {
    std::array<double, unknowns> gradient;
    double weight, mask, edge, edge_weighted;
  };

  GELFLOW_INLINE static FloatPack load(const Values& values, int p) {
    FloatPack pack;
    std::memcpy(&pack, &values[std::size_t(p)], sizeof pack);
    return pack;
  }
  GELFLOW_INLINE static void store(FloatPack pack, Values& values, int p) {
    std::memcpy(&values[std::size_t(p)], &pack, sizeof pack);
  }

  // Positions of the points relative to the centre: ρ = |d| (1 − e₄) − e₃ with the waves e of the outline.
  void place_points(const DotShape& shape, const DotMask* mask, Samples& samples) const {
    const auto& w = shape.waves;
    const FloatPack one = FloatPack{} + 1;
    for (int p = 0; p < points; p += pack_size) {
      const FloatPack c = load(cos_, p), s = load(sin_, p);
      const FloatPack third = bulge({w[0], w[1], 0, 0}, c, s, one), fourth = bulge({0, 0, w[2], w[3]}, c, s, one);
      const FloatPack distance = (load(radius_, p) + third) / (1 - fourth), u = distance * c, v = distance * s;
      const auto [right, down] = to_image(shape, u, v);
      store(right, samples.right, p), store(down, samples.down, p);
      store(mask ? sample_mask(*mask, u, v) : one, samples.mask, p);
    }
  }

  GELFLOW_CLONES static void sample(const Plane& plane, float x, float y, Samples& samples) {
    for (int p = 0; p < points; ++p) {
      const float right = x + samples.right[p], down = y + samples.down[p];
      const bool inside = right >= 0 && down >= 0 && right < float(plane.width - 1) && down < float(plane.height - 1);
      samples.inside[p] = inside ? samples.mask[p] : 0;
      const int column = inside ? int(right) : 0, line = inside ? int(down) : 0;
      const float across = right - float(column), along = down - float(line);
      const std::uint8_t* first = plane.row(line) + column;
      const std::uint8_t* second = first + plane.stride;
      const float upper = float(first[0]) + across * (float(first[1]) - float(first[0]));
      const float lower = float(second[0]) + across * (float(second[1]) - float(second[0]));
      samples.pixel[p] = inside ? upper + along * (lower - upper) : 0;
    }
  }

  // Mean over the outermost points.
  static double brightness(const Samples& samples) {
    double sum = 0, weight = 1e-9;
    for (int p = points - angles; p < points; ++p) {
      sum += double(samples.pixel[p] * samples.inside[p]), weight += double(samples.inside[p]);
    }
    return std::max(sum / weight, 4.0);
  }

  GELFLOW_CLONES void accumulate(const Samples& samples, const std::array<double, terms>& light, float a, float k,
                                 Sums& sums) const {
    const float b = float(std::max(light[0], 1.0)), inverse = 1 / b, k2 = 1 / (k * k);
    std::array<FloatPack, unknowns> total{};
    FloatPack weight{}, masked{}, edge{}, edge_weighted{};
    for (int p = 0; p < points; p += pack_size) {
      std::array<FloatPack, terms> basis;
      FloatPack model{};
      for (std::size_t i = 0; i < terms; ++i) basis[i] = load(background_[i], p), model += float(light[i]) * basis[i];
      const FloatPack s = load(profile_, p), slope = load(slope_, p), inside = load(samples.inside, p);
      const FloatPack ink = 1 + a * s, r = load(samples.pixel, p) - model * ink;
      const FloatPack w = inside / (1 + r * r * k2), psi = w * r * inverse, psi_ink = psi * ink,
                      psi_slope = psi * slope;
      total[0] += psi_slope * load(cos_, p), total[1] += psi_slope * load(sin_, p), total[2] += psi * s;
      for (std::size_t i = 0; i < terms; ++i) total[3 + i] += psi_ink * basis[i];
      weight += w, masked += inside, edge += inside * slope * slope,
          edge_weighted += inside * slope * slope / (1 + r * r * (k2 * scale_factor * scale_factor));
    }
    for (std::size_t i = 0; i < unknowns; ++i) sums.gradient[i] = sum_lanes(total[i]);
    sums.gradient[0] *= -contrast_, sums.gradient[1] *= -contrast_;
    sums.weight = sum_lanes(weight), sums.mask = sum_lanes(masked);
    sums.edge = sum_lanes(edge), sums.edge_weighted = sum_lanes(edge_weighted);
  }

  double contrast_;
  bool is_valid_ = false;
  Values radius_, cos_, sin_, profile_, slope_;
  std::array<Values, terms> background_;
  std::array<double, unknowns * unknowns> inverse_;
};

}  // namespace gelflow::perception
