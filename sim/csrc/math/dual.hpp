// Dual numbers a + b ε, ε² = 0, for forward-mode differentiation. The core is instantiated with them to verify its
// analytic derivatives. Order comparisons use the real part only, so that a dual run takes the same branches as the real
// run.
#pragma once

#include <Eigen/Core>
#include <cmath>

namespace gelflow {

struct Dual {
  double a = 0;  // value
  double b = 0;  // derivative along the seeded direction

  Dual() = default;
  Dual(double value) : a(value) {}  // implicit, so that constants mix with duals
  Dual(double value, double derivative) : a(value), b(derivative) {}

  Dual& operator+=(const Dual& o) { return *this = Dual(a + o.a, b + o.b); }
  Dual& operator-=(const Dual& o) { return *this = Dual(a - o.a, b - o.b); }
  Dual& operator*=(const Dual& o) { return *this = Dual(a * o.a, a * o.b + b * o.a); }
  Dual& operator/=(const Dual& o) { return *this = Dual(a / o.a, (b - a / o.a * o.b) / o.a); }

  friend Dual operator+(Dual x, const Dual& y) { return x += y; }
  friend Dual operator-(Dual x, const Dual& y) { return x -= y; }
  friend Dual operator*(Dual x, const Dual& y) { return x *= y; }
  friend Dual operator/(Dual x, const Dual& y) { return x /= y; }
  friend Dual operator-(const Dual& x) { return {-x.a, -x.b}; }
  friend Dual operator+(const Dual& x) { return x; }

  friend bool operator<(const Dual& x, const Dual& y) { return x.a < y.a; }
  friend bool operator>(const Dual& x, const Dual& y) { return x.a > y.a; }
  friend bool operator<=(const Dual& x, const Dual& y) { return x.a <= y.a; }
  friend bool operator>=(const Dual& x, const Dual& y) { return x.a >= y.a; }
  // Equality compares both parts: a linear solver that skips zeros must not skip a zero with a derivative.
  friend bool operator==(const Dual& x, const Dual& y) { return x.a == y.a && x.b == y.b; }
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
    ReadCost = 2,
    AddCost = 2,
    MulCost = 6
  };
};
}  // namespace Eigen
