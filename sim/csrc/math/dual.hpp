// Dual numbers a + Σ b_k ε_k, ε_j ε_k = 0, for forward-mode differentiation along several directions at once. The core is
// instantiated with them to verify its analytic derivatives. Order comparisons use the real part only, so that a dual run
// takes the same branches as the real run.
#pragma once

#include <Eigen/Core>
#include <cmath>

namespace gelflow {

struct Dual {
  static constexpr int directions = 4;
  // Vector extension of GCC and Clang, with the alignment of a double: Eigen's arrays have no larger one.
  typedef double Vector __attribute__((vector_size(directions * sizeof(double)), aligned(sizeof(double))));

  double a = 0;  // value
  Vector b{};    // derivatives along the seeded directions

  Dual() = default;
  Dual(double value) : a(value) {}  // implicit, so that constants mix with duals
  Dual(double value, const Vector& derivatives) : a(value), b(derivatives) {}

  Dual& operator+=(const Dual& o) { return *this = *this + o; }
  Dual& operator-=(const Dual& o) { return *this = *this - o; }
  Dual& operator*=(const Dual& o) { return *this = *this * o; }
  Dual& operator/=(const Dual& o) { return *this = *this / o; }

  friend Dual operator+(const Dual& x, const Dual& y) { return {x.a + y.a, x.b + y.b}; }
  friend Dual operator-(const Dual& x, const Dual& y) { return {x.a - y.a, x.b - y.b}; }
  friend Dual operator*(const Dual& x, const Dual& y) { return {x.a * y.a, x.a * y.b + x.b * y.a}; }
  friend Dual operator/(const Dual& x, const Dual& y) {
    const double ratio = x.a / y.a;
    return {ratio, (x.b - ratio * y.b) / y.a};
  }
  friend Dual operator-(const Dual& x) { return {-x.a, -x.b}; }
  friend Dual operator+(const Dual& x) { return x; }

  friend bool operator<(const Dual& x, const Dual& y) { return x.a < y.a; }
  friend bool operator>(const Dual& x, const Dual& y) { return x.a > y.a; }
  friend bool operator<=(const Dual& x, const Dual& y) { return x.a <= y.a; }
  friend bool operator>=(const Dual& x, const Dual& y) { return x.a >= y.a; }
  // Equality compares all parts: a linear solver that skips zeros must not skip a zero with a derivative.
  friend bool operator==(const Dual& x, const Dual& y) {
    bool equal = x.a == y.a;
    for (int k = 0; k < directions; ++k) equal = equal && x.b[k] == y.b[k];
    return equal;
  }
  friend bool operator!=(const Dual& x, const Dual& y) { return !(x == y); }
};

inline Dual sqrt(const Dual& x) {
  const double root = std::sqrt(x.a);
  return {root, x.b / (2 * root)};
}
inline Dual sin(const Dual& x) { return {std::sin(x.a), std::cos(x.a) * x.b}; }
inline Dual cos(const Dual& x) { return {std::cos(x.a), -std::sin(x.a) * x.b}; }
inline Dual abs(const Dual& x) { return x.a < 0 ? -x : x; }

inline double real_part(double x) { return x; }
inline double real_part(float x) { return x; }
inline double real_part(const Dual& x) { return x.a; }

template <class T>
inline bool is_finite(const T& x) {
  return std::isfinite(real_part(x));
}

}  // namespace gelflow

namespace Eigen {
template <>
struct NumTraits<gelflow::Dual> : NumTraits<double> {
  using Real = gelflow::Dual;
  using NonInteger = gelflow::Dual;
  using Nested = gelflow::Dual;
  using Literal = gelflow::Dual;
  enum {
    IsComplex = 0,
    IsInteger = 0,
    IsSigned = 1,
    RequireInitialization = 1,
    ReadCost = 1 + gelflow::Dual::directions,
    AddCost = 1 + gelflow::Dual::directions,
    MulCost = 1 + 3 * gelflow::Dual::directions
  };
};
}  // namespace Eigen
