// A dot's centre by least squares, with the shape of the dot known.
//
// Around a dot the plane is light that changes linearly, times one plus the dot's contrast times its shape:
//
//   m(x) = b (1 + β·(x − w)) (1 + a s(q)),   q = (x − p)ᵀ Q (x − p),
//
// with the window's middle w, the shape s learned at the start (1 inside, 0 outside; a table over q), and Q the dot's
// oval, which belongs to the marker. Unknown are the centre p, the contrast a, the light b and its slope β. The light
// has to be in it: a slope of 1 % per pixel that is left out moves the centre by a quarter of a pixel.
//
// The residual r = I − m enters as ψ(r) = r / (1 + (r/k)²), so that scratches, highlights, bridges and a neighbour's
// edge count little. With J = ∂m/∂(p, a, b, bβ) / b, Gauss-Newton is
//
//   δ = H⁻¹ Σ Jᵀ ψ(r)/b,   H = Σ JᵀJ,
//
// where H, computed once per marker for a dot in the middle of a pixel and its contrast at rest, is near enough:
// the sum that has to vanish does not depend on it. So a pass only has six sums over the window.
#pragma once

#include <array>
#include <cmath>

#include "image.hpp"

namespace gelflow::perception {

// Eight pixels at a time: GCC's and Clang's vector extensions, of which the compiler makes what the processor has.
typedef float Floats __attribute__((vector_size(32)));
typedef std::int32_t Ints __attribute__((vector_size(32)));
constexpr int lanes = 8;
constexpr double nearly = 0.1;   // step of a pass [px] down to which every second line will do
constexpr double close = 0.015;  // step after which the next one would be a tenth of it: done

struct Shape {
  static constexpr int steps = 256;
  std::array<float, steps + 2> value;  // s at q = 0 … reach in equal steps, and 0 once more
  float reach;                         // s is 0 from this q on
};

struct Oval {
  float xx, xy, yy;  // Q [1/px²]
};

struct Fit {
  Point place;
  double contrast = 0;  // a
  double quality = 0;   // share of the dot's edge that the shape explains, 0 to 1
};

// The pixels around a dot: `size` of them wide (a multiple of `lanes`) and high.
struct Window {
  static constexpr int largest = 48;
  int left, top, size;
  alignas(32) std::array<float, largest * largest> pixels;
};

GELFLOW_CLONES inline void take_window(const std::uint8_t* __restrict first, int stride, int size,
                                       float* __restrict pixels) {
  for (int row = 0; row < size; ++row)
    for (int x = 0; x < size; ++x) pixels[row * size + x] = float(first[row * stride + x]);
}

// Values of the model at one pass, and the sums over the window that it needs.
struct Pass {
  int every;                     // only every so many-th line is looked at
  float x, y;                    // the centre, from the window's middle [px]
  float a, b, slope_x, slope_y;  // contrast, light, and β
  float k;                       // residual from which on a pixel counts little [grey levels]
  double sums[6];                // Jᵀψ, in the order of the unknowns
  double edge, edge_kept;        // Σ|∇s|², plain and with the pixels' weights
  double weight;                 // of all pixels
};

struct Sample {
  Floats s, gx, gy;  // the shape and its slope by p, in the window's coordinates
};

GELFLOW_INLINE Sample sample(const Shape& shape, const Oval& oval, Floats dx, float dy) {
  const float scale = float(Shape::steps) / shape.reach;
  const Floats qx = oval.xx * dx + oval.xy * dy, qy = oval.xy * dx + oval.yy * dy;
  Floats t = scale * (qx * dx + qy * dy);
  t = t < float(Shape::steps) ? t : Floats{} + float(Shape::steps);
  const Ints index = __builtin_convertvector(t, Ints);
  const Floats part = t - __builtin_convertvector(index, Floats);
  Floats low, high;
  for (int l = 0; l < lanes; ++l) {
    low[l] = shape.value[std::size_t(index[l])];
    high[l] = shape.value[std::size_t(index[l]) + 1];
  }
  const Floats slope = (high - low) * (-2 * scale);
  return {low + part * (high - low), slope * qx, slope * qy};
}

GELFLOW_INLINE double total(Floats v) {
  double sum = 0;
  for (int l = 0; l < lanes; ++l) sum += double(v[l]);
  return sum;
}

GELFLOW_CLONES inline void run_pass(const Window& window, int width, int height, const Shape& shape, const Oval& oval,
                                    Pass& pass) {
  const float middle = 0.5f * float(window.size - 1), k2 = 1 / (pass.k * pass.k);
  Floats px{}, py{}, pa{}, pb{}, bx{}, by{}, edge{}, kept{}, weight{};
  const Floats ramp = {0, 1, 2, 3, 4, 5, 6, 7};
  for (int row = std::max(0, -window.top); row < std::min(window.size, height - window.top); row += pass.every) {
    const float y = float(row) - middle;
    const float* line = &window.pixels[std::size_t(row * window.size)];
    for (int start = 0; start < window.size; start += lanes) {
      const Floats x = ramp + (float(start) - middle);
      Floats pixel;
      std::memcpy(&pixel, line + start, sizeof pixel);
      const Floats column = x + (middle + float(window.left));
      const Sample dot = sample(shape, oval, x - pass.x, y - pass.y);
      const Floats ink = 1 + pass.a * dot.s;
      const Floats r = pixel - pass.b * (1 + pass.slope_x * x + pass.slope_y * y) * ink;
      Floats w = 1 / (1 + r * r * k2);
      const auto outside = (column < 0) | (column > float(width - 1));
      w = outside ? Floats{} : w;
      const Floats psi = w * r, square = dot.gx * dot.gx + dot.gy * dot.gy, lit = psi * ink;
      px += psi * dot.gx;
      py += psi * dot.gy;
      pa += psi * dot.s;
      pb += lit;
      bx += lit * x;
      by += lit * y;
      edge += square;
      kept += w * square;
      weight += w;
    }
  }
  const double share = 1.0 / pass.b;
  const double a = pass.a;
  const std::array<double, 6> sums = {a * total(px), a * total(py), total(pa), total(pb), total(bx), total(by)};
  for (int i = 0; i < 6; ++i) pass.sums[i] = share * sums[std::size_t(i)];
  pass.edge = total(edge), pass.edge_kept = total(kept);
  pass.weight = total(weight);
}

// H⁻¹ of a marker, row by row.
using Inverse = std::array<double, 36>;

// Of a symmetric positive matrix, by Gauss-Jordan; false when it is singular.
inline bool invert(std::array<double, 36>& matrix, Inverse& inverse) {
  inverse.fill(0);
  for (int i = 0; i < 6; ++i) inverse[std::size_t(7 * i)] = 1;
  for (std::size_t i = 0; i < 6; ++i) {
    const double pivot = matrix[7 * i];
    if (!(pivot > 1e-9)) return false;
    for (std::size_t j = 0; j < 6; ++j) matrix[6 * i + j] /= pivot, inverse[6 * i + j] /= pivot;
    for (std::size_t k = 0; k < 6; ++k) {
      const double factor = matrix[6 * k + i];
      if (k == i || factor == 0) continue;
      for (std::size_t j = 0; j < 6; ++j) {
        matrix[6 * k + j] -= factor * matrix[6 * i + j];
        inverse[6 * k + j] -= factor * inverse[6 * i + j];
      }
    }
  }
  return true;
}

GELFLOW_CLONES inline bool normal_inverse(const Shape& shape, const Oval& oval, double contrast, int size,
                                          Inverse& inverse) {
  std::array<Floats, 36> sums{};
  const float middle = 0.5f * float(size - 1);
  const Floats ramp = {0, 1, 2, 3, 4, 5, 6, 7};
  for (int row = 0; row < size; ++row)
    for (int start = 0; start < size; start += lanes) {
      const Floats x = ramp + (float(start) - middle);
      const float y = float(row) - middle, a = float(contrast);
      const Sample dot = sample(shape, oval, x, y);
      const Floats ink = 1 + a * dot.s;
      const std::array<Floats, 6> j = {a * dot.gx, a * dot.gy, dot.s, ink, ink * x, ink * y};
      for (std::size_t i = 0; i < 6; ++i)
        for (std::size_t l = 0; l <= i; ++l) sums[6 * i + l] += j[i] * j[l];
    }
  std::array<double, 36> h;
  for (std::size_t i = 0; i < 6; ++i)
    for (std::size_t l = 0; l <= i; ++l) h[6 * i + l] = h[6 * l + i] = total(sums[6 * i + l]);
  return invert(h, inverse);
}

struct FitSettings {
  Shape shape;
  int window;     // size of the window [px]
  double radius;  // of a dot [px]
  double noise;   // of a pixel at rest, as a share of the light
};

// Fits one dot from `place` on. `rest_contrast` is what H⁻¹ was computed with. A fit that leaves the window's middle
// part or turns dark into bright has quality 0.
inline Fit fit_dot(const Plane& plane, const FitSettings& settings, const Oval& oval, const Inverse& inverse,
                   double rest_contrast, Point place, int most_passes) {
  const int size = settings.window;
  const double middle = 0.5 * (size - 1), limit = 0.8 * settings.radius + 1;
  Window window;
  window.left = int(std::floor(place.x - middle + 0.5)), window.top = int(std::floor(place.y - middle + 0.5));
  window.size = size;
  const Point corner = {window.left + middle, window.top + middle}, begin = place - corner;
  take_window(plane.row(0) + std::ptrdiff_t(window.top) * plane.stride + window.left, plane.stride, size,
              window.pixels.data());
  // A coarse guess of the light will do: what is seen along the window's edge.
  double light = 0;
  for (int i = 0; i < size; ++i)
    for (int edge : {i, size * (size - 1) + i, size * i, size * i + size - 1})
      light += window.pixels[std::size_t(edge)];
  light = std::max(4.0, light / (4 * size));
  Pass pass{};
  pass.x = float(begin.x), pass.y = float(begin.y), pass.a = float(rest_contrast), pass.b = float(light);
  bool coarse = true;
  for (int number = 0; number < most_passes; ++number) {
    pass.k = pass.b * float(std::max(0.16 * std::abs(double(pass.a)), 3 * settings.noise));
    pass.every = coarse ? 2 : 1;
    run_pass(window, plane.width, plane.height, settings.shape, oval, pass);
    // Pixels that count little or are left out are missing from the sums, but not from H.
    const double more = std::min(4.0, double(size * size) / std::max(pass.weight, 1.0));
    std::array<double, 6> step{};
    for (std::size_t i = 0; i < 6; ++i)
      for (std::size_t j = 0; j < 6; ++j) step[i] += more * inverse[6 * i + j] * pass.sums[j];
    const double most = 0.5 * settings.radius;
    step[0] = std::clamp(step[0], -most, most), step[1] = std::clamp(step[1], -most, most);
    pass.x += float(step[0]), pass.y += float(step[1]), pass.a += float(step[2]);
    pass.b = std::clamp(pass.b * float(1 + std::clamp(step[3], -0.5, 1.0)), 1.0f, 512.0f);
    pass.slope_x += float(step[4]), pass.slope_y += float(step[5]);
    const bool lost = !(std::abs(pass.x - begin.x) < limit && std::abs(pass.y - begin.y) < limit) ||
                      !(pass.a * rest_contrast > 0.01 * rest_contrast * rest_contrast);
    if (lost) return {place, 0, 0};
    const double moved = std::max(std::abs(step[0]), std::abs(step[1]));
    if (!coarse && moved < close) break;
    coarse = coarse && moved > nearly;
  }
  const double edge = std::max(pass.edge, 1e-9);
  return {corner + Point{pass.x, pass.y}, pass.a, std::clamp(pass.edge_kept / edge, 0.0, 1.0)};
}

}  // namespace gelflow::perception
