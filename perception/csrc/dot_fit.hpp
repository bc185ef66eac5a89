// Least-squares fit of the centre of a dot with a known profile.
//
// The image around a dot is modelled as a linear background times one plus the contrast of the dot times its profile:
//
//   m(x) = b (1 + β·(x − w)) (1 + a s(q)),   q = |d|² (1 − e(d))²,   d = F (x − p),
//
// with the window centre w, the profile s of all dots (1 inside, 0 outside; a table over q), and the shape of the
// marker's dot: the frame F, in which the dot is a disc of radius 1, and the waves e of its ragged outline, with three
// and four periods around the dot. The unknowns are the centre p, the contrast a, the background b and its slope β. The
// slope is required: an unmodelled slope of 1 % per pixel shifts the centre by a quarter of a pixel.
//
// The residual r = I − m enters through ψ(r) = r / (1 + (r/k)²), which limits the influence of scratches, highlights,
// bridges and neighbouring dots. With J = ∂m/∂(p, a, b, bβ) / b, the Gauss-Newton step is
//
//   δ = H⁻¹ Σ Jᵀ ψ(r)/b,   H = Σ JᵀJ.
//
// H is computed once per marker, for a dot at rest between four pixels. This approximation changes the convergence rate
// but not the solution of Σ Jᵀ ψ(r) = 0; an iteration then needs only six sums. The sums include a square around the dot
// that moves with it by parts of a pixel: if it moved by whole pixels, so would its part of a background that is not
// linear, and the centre with it.
#pragma once

#include <array>
#include <cmath>
#include <utility>

#include "image.hpp"

namespace gelflow::perception {

// Packs of eight pixels, with the vector extensions of GCC and Clang.
typedef float FloatPack __attribute__((vector_size(32)));
typedef std::int32_t IntPack __attribute__((vector_size(32)));
constexpr int pack_size = 8;
constexpr FloatPack pack_ramp = {0, 1, 2, 3, 4, 5, 6, 7};
constexpr double coarse_tolerance = 0.1;    // step [px] down to which every second line suffices
constexpr double recentre_distance = 0.6;   // of a dot from the centre of its window that moves the window [px]
constexpr double contrast_tolerance = 0.1;  // step of the contrast / contrast at rest down to which a fit has converged
constexpr double background_tolerance = 0.5;  // largest step of the background / scale of the robust weights
constexpr double tolerance = 0.015;           // converged: the next step would be about a tenth of this one [px]

struct DotProfile {
  static constexpr int steps = 256;
  std::array<float, steps + 2> value;  // s at `steps` + 1 equidistant q from 0 to `reach`, then 0
  float reach;                         // s = 0 for larger q
};

struct DotShape {
  float xx, xy, yx, yy;          // F, row-major [1/px]
  std::array<float, 4> waves{};  // coefficients of Re z³, Im z³, Re z⁴, Im z⁴ over |z|⁴, z = d₁ + i d₂
};

// The offset (right, down) [px] of (u, v) in the frame of the dot.
template <class Number>
GELFLOW_INLINE std::array<Number, 2> to_image(const DotShape& shape, Number u, Number v) {
  const float area = shape.xx * shape.yy - shape.xy * shape.yx;
  return {(shape.yy * u - shape.xy * v) / area, (shape.xx * v - shape.yx * u) / area};
}

// Which part of a dot its shape describes: weight 1 where it does, 0 where ink is missing or another dot is joined. A
// table over the frame of the dot; pixels beyond it take the weight of the nearest cell.
struct DotMask {
  static constexpr int cells = 32;      // along an axis
  static constexpr float reach = 2.0f;  // the table extends from -reach to reach [radii]
  std::array<float, cells * cells> weight;
};

struct DotFit {
  Point position;
  double contrast = 0;  // a
  double quality = 0;   // fraction of the edge of the dot that the profile explains, 0 to 1
};

GELFLOW_CLONES inline void copy_window(const std::uint8_t* __restrict first, int stride, int size,
                                       float* __restrict pixels) {
  for (int row = 0; row < size; ++row)
    for (int x = 0; x < size; ++x) pixels[row * size + x] = float(first[row * stride + x]);
}

// The pixels around a dot; the side `size` is a multiple of `pack_size`.
struct Window {
  static constexpr int largest = 64;
  int left, top, size;
  alignas(32) std::array<float, largest * largest> pixels;

  // Reads the pixels around `position` and returns the centre of the window, at most half a pixel away.
  Point read(const Plane& plane, Point position) {
    const double middle = 0.5 * (size - 1);
    left = int(std::floor(position.x - middle + 0.5)), top = int(std::floor(position.y - middle + 0.5));
    copy_window(plane.row(0) + std::ptrdiff_t(top) * plane.stride + left, plane.stride, size, pixels.data());
    return {left + middle, top + middle};
  }
};

// Model parameters of one iteration, and the sums over the window.
struct FitState {
  int row_step;                  // distance of the lines that are used
  float x, y;                    // centre of the dot relative to the window centre [px]
  float a, b, slope_x, slope_y;  // contrast, background, and β
  float k;                       // scale of the robust weight [grey levels]
  double sums[6];                // Σ Jᵀψ, in the order of the unknowns
  double edge, edge_weighted;    // Σ|∇s|², unweighted and with the robust weights
  double weight;                 // sum of the robust weights

  // The same state relative to a window centre that is moved by `offset`.
  void recentre(Point offset) {
    x -= float(offset.x), y -= float(offset.y);
    const float change = std::max(0.2f, 1 + slope_x * float(offset.x) + slope_y * float(offset.y));
    b *= change, slope_x /= change, slope_y /= change;
  }
};

struct ProfileSample {
  FloatPack s, gx, gy;  // profile and its derivative by p in window coordinates
  FloatPack x, y;       // d
};

// e at d = (x, y); its denominator is limited, for d = 0.
GELFLOW_INLINE FloatPack bulge(const std::array<float, 4>& waves, FloatPack x, FloatPack y, FloatPack square) {
  const FloatPack bounded = square > 0.25f ? square : FloatPack{} + 0.25f;
  const FloatPack re2 = x * x - y * y, im2 = 2 * x * y;
  const FloatPack third = waves[0] * (x * re2 - y * im2) + waves[1] * (x * im2 + y * re2);
  const FloatPack fourth = waves[2] * (re2 * re2 - im2 * im2) + waves[3] * (2 * re2 * im2);
  return (third + fourth) / (bounded * bounded);
}

// The derivative neglects the change of e.
GELFLOW_INLINE ProfileSample sample_profile(const DotProfile& profile, const DotShape& shape, FloatPack dx, float dy) {
  const FloatPack x = shape.xx * dx + shape.xy * dy, y = shape.yx * dx + shape.yy * dy, square = x * x + y * y;
  const FloatPack shrink = 1 - bulge(shape.waves, x, y, square);
  const FloatPack scale = (float(DotProfile::steps) / profile.reach) * (shrink * shrink);
  FloatPack t = scale * square;
  t = t < float(DotProfile::steps) ? t : FloatPack{} + float(DotProfile::steps);
  const IntPack index = __builtin_convertvector(t, IntPack);
  const FloatPack part = t - __builtin_convertvector(index, FloatPack);
  FloatPack low, high;
  for (int l = 0; l < pack_size; ++l) {
    low[l] = profile.value[std::size_t(index[l])];
    high[l] = profile.value[std::size_t(index[l]) + 1];
  }
  const FloatPack slope = (high - low) * (-2 * scale);
  const FloatPack gx = slope * (shape.xx * x + shape.yx * y), gy = slope * (shape.xy * x + shape.yy * y);
  return {low + part * (high - low), gx, gy, x, y};
}

GELFLOW_INLINE FloatPack sample_mask(const DotMask& mask, FloatPack x, FloatPack y) {
  constexpr float scale = 0.5f * DotMask::cells / DotMask::reach, last = DotMask::cells - 1;
  FloatPack column = scale * (x + DotMask::reach), row = scale * (y + DotMask::reach);
  column = column > 0 ? column : FloatPack{}, row = row > 0 ? row : FloatPack{};
  column = column < last ? column : FloatPack{} + last, row = row < last ? row : FloatPack{} + last;
  const IntPack right = __builtin_convertvector(column, IntPack), down = __builtin_convertvector(row, IntPack);
  FloatPack weight;
  for (int l = 0; l < pack_size; ++l) weight[l] = mask.weight[std::size_t(DotMask::cells * down[l] + right[l])];
  return weight;
}

// Part of each pixel that is within the square of the side `size` around a dot; `dx`, `dy`: from its centre [px].
GELFLOW_INLINE FloatPack within_square(int size, FloatPack dx, float dy) {
  const FloatPack beside = 0.5f * float(size) - (dx < 0 ? -dx : dx), positive = beside > 0 ? beside : FloatPack{};
  const float above = std::clamp(0.5f * float(size) - std::abs(dy), 0.0f, 1.0f);
  return above * (positive < 1 ? positive : FloatPack{} + 1);
}

// `weight` where `column` is inside the image, else 0.
GELFLOW_INLINE FloatPack inside(FloatPack column, int width, FloatPack weight) {
  return (column < 0) | (column > float(width - 1)) ? FloatPack{} : weight;
}

GELFLOW_INLINE double sum_lanes(FloatPack v) {
  double sum = 0;
  for (int l = 0; l < pack_size; ++l) sum += double(v[l]);
  return sum;
}

GELFLOW_CLONES inline void accumulate(const Window& window, int width, int height, const DotProfile& profile,
                                      const DotShape& shape, const DotMask* mask, FitState& state) {
  const float middle = 0.5f * float(window.size - 1), k2 = 1 / (state.k * state.k);
  FloatPack px{}, py{}, pa{}, pb{}, bx{}, by{}, edge{}, edge_weighted{}, weight{};
  for (int row = std::max(0, -window.top); row < std::min(window.size, height - window.top); row += state.row_step) {
    const float y = float(row) - middle;
    const float* line = &window.pixels[std::size_t(row * window.size)];
    for (int start = 0; start < window.size; start += pack_size) {
      const FloatPack x = pack_ramp + (float(start) - middle), dx = x - state.x;
      FloatPack pixel;
      std::memcpy(&pixel, line + start, sizeof pixel);
      const ProfileSample dot = sample_profile(profile, shape, dx, y - state.y);
      const FloatPack ink = 1 + state.a * dot.s;
      const FloatPack r = pixel - state.b * (1 + state.slope_x * x + state.slope_y * y) * ink;
      FloatPack used = within_square(window.size, dx, y - state.y);
      if (mask) used *= sample_mask(*mask, dot.x, dot.y);
      const FloatPack w = inside(x + (middle + float(window.left)), width, used) / (1 + r * r * k2);
      const FloatPack square = used * (dot.gx * dot.gx + dot.gy * dot.gy);
      const FloatPack psi = w * r, lit = psi * ink;
      px += psi * dot.gx;
      py += psi * dot.gy;
      pa += psi * dot.s;
      pb += lit;
      bx += lit * x;
      by += lit * y;
      edge += square;
      edge_weighted += w * square;
      weight += w;
    }
  }
  const double share = 1.0 / state.b;
  const double a = state.a;
  const std::array<double, 6> sums = {a * sum_lanes(px), a * sum_lanes(py), sum_lanes(pa),
                                      sum_lanes(pb),     sum_lanes(bx),     sum_lanes(by)};
  for (int i = 0; i < 6; ++i) state.sums[i] = share * sums[std::size_t(i)];
  state.edge = sum_lanes(edge), state.edge_weighted = sum_lanes(edge_weighted);
  state.weight = sum_lanes(weight);
}

// The Gauss-Newton steps of a marker.
struct FitBasis {
  int window;                      // side of the window [px]
  double pixels = 0;               // that H includes
  std::array<double, 36> inverse;  // H⁻¹, row-major
};

// Inverts a symmetric positive definite matrix by Gauss-Jordan elimination; false when it is singular.
template <std::size_t n>
bool invert(std::array<double, n * n>& matrix, std::array<double, n * n>& inverse) {
  inverse.fill(0);
  for (std::size_t i = 0; i < n; ++i) inverse[(n + 1) * i] = 1;
  for (std::size_t i = 0; i < n; ++i) {
    const double pivot = matrix[(n + 1) * i];
    if (!(pivot > 1e-9)) return false;
    for (std::size_t j = 0; j < n; ++j) matrix[n * i + j] /= pivot, inverse[n * i + j] /= pivot;
    for (std::size_t k = 0; k < n; ++k) {
      const double factor = matrix[n * k + i];
      if (k == i || factor == 0) continue;
      for (std::size_t j = 0; j < n; ++j) {
        matrix[n * k + j] -= factor * matrix[n * i + j];
        inverse[n * k + j] -= factor * inverse[n * i + j];
      }
    }
  }
  return true;
}

// The basis for a dot at `rest` in an image of this size; its `pixels` are 0 where they do not determine the centre.
GELFLOW_CLONES inline FitBasis fit_basis(const DotProfile& profile, const DotShape& shape, const DotMask* mask,
                                         double contrast, int window, Point rest, int width, int height) {
  std::array<FloatPack, 36> sums{};
  FloatPack pixels{};
  const float middle = 0.5f * float(window - 1), a = float(contrast);
  for (int row = 0; row < window; ++row)
    for (int start = 0; start < window; start += pack_size) {
      const FloatPack x = pack_ramp + (float(start) - middle);
      const float y = float(row) - middle;
      if (y + float(rest.y) < 0 || y + float(rest.y) > float(height - 1)) continue;
      const ProfileSample dot = sample_profile(profile, shape, x, y);
      FloatPack used = inside(x + float(rest.x), width, within_square(window, x, y));
      if (mask) used *= sample_mask(*mask, dot.x, dot.y);
      const FloatPack ink = 1 + a * dot.s;
      const std::array<FloatPack, 6> j = {a * dot.gx, a * dot.gy, dot.s, ink, ink * x, ink * y};
      for (std::size_t i = 0; i < 6; ++i)
        for (std::size_t l = 0; l <= i; ++l) sums[6 * i + l] += used * j[i] * j[l];
      pixels += used;
    }
  std::array<double, 36> h;
  for (std::size_t i = 0; i < 6; ++i)
    for (std::size_t l = 0; l <= i; ++l) h[6 * i + l] = h[6 * l + i] = sum_lanes(sums[6 * i + l]);
  FitBasis basis{window, 0, {}};
  if (invert<6>(h, basis.inverse)) basis.pixels = sum_lanes(pixels);
  return basis;
}

struct FitSettings {
  DotProfile profile;
  double radius;  // of a dot [px]
  double noise;   // standard deviation of a pixel at rest / background
};

struct FitStart {
  Point position;
  int max_iterations;
  bool is_close = false;  // to the solution: no iterations with every second line
};

// The background along the border of the window, a sufficient initial value; without pixels outside the image. Its slope
// saves a step where the fit begins close to the dot, and misleads other fits where a highlight is at the border.
inline void start_background(const Window& window, int width, int height, bool with_slope, FitState& state) {
  double sum = 0, count = 0, across = 0, down = 0;
  const int size = window.size;
  const double middle = 0.5 * (size - 1);
  for (int i = 0; i < size; ++i)
    for (const auto& [x, y] : {std::pair{i, 0}, {i, size - 1}, {0, i}, {size - 1, i}}) {
      const int column = window.left + x, row = window.top + y;
      if (column < 0 || row < 0 || column >= width || row >= height) continue;
      const double pixel = double(window.pixels[std::size_t(size * y + x)]);
      sum += pixel, across += (x - middle) * pixel, down += (y - middle) * pixel, ++count;
    }
  state.b = float(std::max(4.0, count > 0 ? sum / count : 0));
  if (!with_slope || count < 4 * size) return;
  const double square = 2 * size * middle * middle * (4.0 / 3);  // sum of (x - middle)² along the border
  state.slope_x = float(across / square) / state.b, state.slope_y = float(down / square) / state.b;
}

// Fits one dot. `rest_contrast` is the contrast for which H⁻¹ was computed, `tolerated` the scale of the robust weight k
// relative to background times contrast. Without a `mask`, the shape describes the whole dot. The quality is 0 when the
// fit moves far from its start or the contrast far from that at rest.
inline DotFit fit_dot(const Plane& plane, const FitSettings& settings, const DotShape& shape, const DotMask* mask,
                      const FitBasis& basis, double rest_contrast, double tolerated, const FitStart& start) {
  const double limit = 0.8 * settings.radius + 1;
  Window window;
  window.size = basis.window;
  Point centre = window.read(plane, start.position);
  FitState state{};
  state.x = float(start.position.x - centre.x), state.y = float(start.position.y - centre.y);
  state.a = float(rest_contrast);
  start_background(window, plane.width, plane.height, start.is_close, state);
  bool coarse = !start.is_close;
  for (int number = 0; number < start.max_iterations; ++number) {
    state.k = state.b * float(std::max(tolerated * std::abs(double(state.a)), 3 * settings.noise));
    state.row_step = coarse ? 2 : 1;
    accumulate(window, plane.width, plane.height, settings.profile, shape, mask, state);
    // H includes all pixels, the sums only those with weight.
    const double scale = std::min(4.0, basis.pixels / std::max(state.weight, 1.0));
    std::array<double, 6> step{};
    for (std::size_t i = 0; i < 6; ++i)
      for (std::size_t j = 0; j < 6; ++j) step[i] += scale * basis.inverse[6 * i + j] * state.sums[j];
    const double max_step = 0.5 * settings.radius;
    step[0] = std::clamp(step[0], -max_step, max_step), step[1] = std::clamp(step[1], -max_step, max_step);
    state.x += float(step[0]), state.y += float(step[1]), state.a += float(step[2]);
    state.b = std::clamp(state.b * float(1 + std::clamp(step[3], -0.5, 1.0)), 1.0f, 512.0f);
    state.slope_x += float(step[4]), state.slope_y += float(step[5]);
    const Point position = centre + Point{state.x, state.y}, off = position - start.position;
    const double ratio = state.a / rest_contrast;
    const bool diverged = !(std::abs(off.x) < limit && std::abs(off.y) < limit && ratio > 0.01 && ratio < 100);
    if (diverged) return {start.position, 0, 0};
    const double moved = std::max(std::abs(step[0]), std::abs(step[1]));
    const double background = std::abs(step[3]) + 0.5 * basis.window * (std::abs(step[4]) + std::abs(step[5]));
    const bool settled = std::abs(step[2]) < contrast_tolerance * std::abs(rest_contrast) &&
                         state.b * background < background_tolerance * state.k;
    if (!coarse && moved < tolerance && settled) break;
    coarse = coarse && moved > coarse_tolerance;
    if (std::max(std::abs(state.x), std::abs(state.y)) > recentre_distance) {
      const Point before = centre;
      centre = window.read(plane, position);
      state.recentre(centre - before);
    }
  }
  const double edge = std::max(state.edge, 1e-9);
  return {centre + Point{state.x, state.y}, state.a, std::clamp(state.edge_weighted / edge, 0.0, 1.0)};
}

}  // namespace gelflow::perception
