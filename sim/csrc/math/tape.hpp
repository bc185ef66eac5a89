// Taped numbers for reverse-mode differentiation. Operations are recorded on a tape; one backward pass over it computes
// the gradient of a weighted sum of results with respect to all variables. The core is instantiated with them for
// gradients with respect to physical parameters, which are computed on request only.
#pragma once

#include <Eigen/Core>
#include <cmath>
#include <vector>

namespace gelflow {

class Tape {
 public:
  // Adds an entry with partial derivatives da, db with respect to the entries a, b (−1: none); returns its index.
  int add(int a, double da, int b, double db) {
    entries_.push_back({a, b, da, db});
    return static_cast<int>(entries_.size()) - 1;
  }
  void clear() { entries_.clear(); }
  // Backward pass. weights: those of the results, one per entry; on return the gradient with respect to every entry.
  void backward(std::vector<double>& weights) const {
    for (int i = static_cast<int>(entries_.size()) - 1; i >= 0; --i) {
      const double w = weights[i];
      if (w == 0) continue;
      const Entry& e = entries_[i];
      if (e.a >= 0) weights[e.a] += w * e.da;
      if (e.b >= 0) weights[e.b] += w * e.db;
    }
  }
  std::size_t size() const { return entries_.size(); }

  // The tape of the calling thread.
  static Tape& current() {
    thread_local Tape tape;
    return tape;
  }

 private:
  struct Entry {
    int a, b;
    double da, db;
  };
  std::vector<Entry> entries_;
};

struct Taped {
  double a = 0;
  int entry = -1;  // index on the tape; −1: a constant

  Taped() = default;
  Taped(double value) : a(value) {}  // implicit, so that constants mix with taped numbers
  Taped(double value, int i, double di, int j = -1, double dj = 0) : a(value) {
    if (i >= 0 || j >= 0) entry = Tape::current().add(i, di, j, dj);
  }
  // An independent variable: the backward pass computes the gradient with respect to it.
  static Taped variable(double value) {
    Taped x(value);
    x.entry = Tape::current().add(-1, 0, -1, 0);
    return x;
  }

  Taped& operator+=(const Taped& o) { return *this = Taped(a + o.a, entry, 1, o.entry, 1); }
  Taped& operator-=(const Taped& o) { return *this = Taped(a - o.a, entry, 1, o.entry, -1); }
  Taped& operator*=(const Taped& o) { return *this = Taped(a * o.a, entry, o.a, o.entry, a); }
  Taped& operator/=(const Taped& o) { return *this = Taped(a / o.a, entry, 1 / o.a, o.entry, -a / (o.a * o.a)); }

  friend Taped operator+(Taped x, const Taped& y) { return x += y; }
  friend Taped operator-(Taped x, const Taped& y) { return x -= y; }
  friend Taped operator*(Taped x, const Taped& y) { return x *= y; }
  friend Taped operator/(Taped x, const Taped& y) { return x /= y; }
  friend Taped operator-(const Taped& x) { return {-x.a, x.entry, -1}; }
  friend Taped operator+(const Taped& x) { return x; }

  friend bool operator<(const Taped& x, const Taped& y) { return x.a < y.a; }
  friend bool operator>(const Taped& x, const Taped& y) { return x.a > y.a; }
  friend bool operator<=(const Taped& x, const Taped& y) { return x.a <= y.a; }
  friend bool operator>=(const Taped& x, const Taped& y) { return x.a >= y.a; }
  friend bool operator==(const Taped& x, const Taped& y) { return x.a == y.a && x.entry == y.entry; }
  friend bool operator!=(const Taped& x, const Taped& y) { return !(x == y); }
};

inline Taped sqrt(const Taped& x) {
  const double root = std::sqrt(x.a);
  return {root, x.entry, 1 / (2 * root)};
}
inline Taped sin(const Taped& x) { return {std::sin(x.a), x.entry, std::cos(x.a)}; }
inline Taped cos(const Taped& x) { return {std::cos(x.a), x.entry, -std::sin(x.a)}; }
inline Taped abs(const Taped& x) { return x.a < 0 ? -x : x; }
inline double real_part(const Taped& x) { return x.a; }

}  // namespace gelflow

namespace Eigen {
template <>
struct NumTraits<gelflow::Taped> : NumTraits<double> {
  using Real = gelflow::Taped;
  using NonInteger = gelflow::Taped;
  using Nested = gelflow::Taped;
  using Literal = gelflow::Taped;
  enum {
    IsComplex = 0,
    IsInteger = 0,
    IsSigned = 1,
    RequireInitialization = 1,
    ReadCost = 2,
    AddCost = 8,
    MulCost = 8
  };
};
}  // namespace Eigen
