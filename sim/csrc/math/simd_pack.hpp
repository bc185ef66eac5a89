// W points at a time: numbers side by side in one register, and the small vectors and matrices made of them.
//
// The functions of one contact point are written once, for a lane type L: a pack of double or float in the simulator, a
// single number where there is nothing to gain (dual numbers). A comparison gives a mask; both sides of a branch are
// computed and `select` takes one per lane. These are GCC's and Clang's vector extensions: the compiler makes of them
// whatever the processor has.
#pragma once

#ifdef __AVX__
#include <immintrin.h>
#endif

#include "math/spatial.hpp"

namespace gelflow {

template <class T, int W>
struct Lanes {
  typedef T Vector __attribute__((vector_size(W * sizeof(T))));
  struct Mask {
    decltype(Vector() < Vector()) m;
    friend GELFLOW_INLINE Mask operator&&(const Mask& x, const Mask& y) { return {x.m & y.m}; }
    friend GELFLOW_INLINE Mask operator||(const Mask& x, const Mask& y) { return {x.m | y.m}; }
    friend GELFLOW_INLINE Mask operator!(const Mask& x) { return {~x.m}; }
  };
  Vector v;

  Lanes() = default;
  GELFLOW_INLINE Lanes(const Vector& values) : v(values) {}
  GELFLOW_INLINE Lanes(T value) : v(value - Vector{}) {}  // implicit on purpose: constants mix freely with packs

  GELFLOW_INLINE Lanes& operator+=(const Lanes& o) { return v += o.v, *this; }
  GELFLOW_INLINE Lanes& operator-=(const Lanes& o) { return v -= o.v, *this; }
  GELFLOW_INLINE Lanes& operator*=(const Lanes& o) { return v *= o.v, *this; }
  friend GELFLOW_INLINE Lanes operator+(const Lanes& x, const Lanes& y) { return x.v + y.v; }
  friend GELFLOW_INLINE Lanes operator-(const Lanes& x, const Lanes& y) { return x.v - y.v; }
  friend GELFLOW_INLINE Lanes operator*(const Lanes& x, const Lanes& y) { return x.v * y.v; }
  friend GELFLOW_INLINE Lanes operator/(const Lanes& x, const Lanes& y) { return x.v / y.v; }
  friend GELFLOW_INLINE Lanes operator-(const Lanes& x) { return -x.v; }
  friend GELFLOW_INLINE Mask operator<(const Lanes& x, const Lanes& y) { return {x.v < y.v}; }
  friend GELFLOW_INLINE Mask operator>(const Lanes& x, const Lanes& y) { return {x.v > y.v}; }
};

// The lane type for numbers of type T: four doubles, eight floats.
template <class T>
struct LaneTypes {
  using Pack = T;
  using Mask = bool;
  static constexpr int width = 1;
};
template <>
struct LaneTypes<double> {
  using Pack = Lanes<double, 4>;
  using Mask = Pack::Mask;
  static constexpr int width = 4;
};
template <>
struct LaneTypes<float> {
  using Pack = Lanes<float, 8>;
  using Mask = Pack::Mask;
  static constexpr int width = 8;
};
template <class T>
using Pack = typename LaneTypes<T>::Pack;
template <class T>
constexpr int pack_width = LaneTypes<T>::width;

template <class L>
struct MaskOf {
  using type = bool;
};
template <class T, int W>
struct MaskOf<Lanes<T, W>> {
  using type = typename Lanes<T, W>::Mask;
};
template <class L>
using Mask = typename MaskOf<L>::type;

template <class L>
struct LaneShape {
  using Scalar = L;
  static constexpr int count = 1;
};
template <class T, int W>
struct LaneShape<Lanes<T, W>> {
  typedef float Reading __attribute__((vector_size(W * sizeof(float))));
  using Scalar = T;
  static constexpr int count = W;
};
template <class L>
using LaneScalar = typename LaneShape<L>::Scalar;
template <class L>
constexpr int lane_count = LaneShape<L>::count;

// One number as a pack of one.
template <class T>
GELFLOW_INLINE T select(bool choice, const T& yes, const T& no) {
  return choice ? yes : no;
}
template <class T>
GELFLOW_INLINE T sum(const T& x) {
  return x;
}
template <class T>
GELFLOW_INLINE const T& lane(const T& x, int) {
  return x;
}
GELFLOW_INLINE bool is_set(bool x, int) { return x; }
template <class T>
GELFLOW_INLINE void set_lane(T& x, int, const T& value) {
  x = value;
}
GELFLOW_INLINE bool any(bool x) { return x; }

template <class T, int W>
GELFLOW_INLINE Lanes<T, W> select(const typename Lanes<T, W>::Mask& choice, const Lanes<T, W>& yes,
                                  const Lanes<T, W>& no) {
  return choice.m ? yes.v : no.v;
}
template <class T, int W>
GELFLOW_INLINE T sum(const Lanes<T, W>& x) {
  T total = x.v[0];
  for (int i = 1; i < W; ++i) total += x.v[i];
  return total;
}
template <class T, int W>
GELFLOW_INLINE T lane(const Lanes<T, W>& x, int i) {
  return x.v[i];
}
template <class T, int W>
GELFLOW_INLINE void set_lane(Lanes<T, W>& x, int i, const T& value) {
  x.v[i] = value;
}
// One bit per lane, the first one lowest.
GELFLOW_INLINE unsigned bits(bool x) { return x ? 1U : 0U; }
template <class M>
GELFLOW_INLINE auto bits(const M& mask) -> decltype(static_cast<unsigned>(mask.m[0])) {
  constexpr unsigned lanes = sizeof(mask.m) / sizeof(mask.m[0]);
#ifdef __AVX__
  if constexpr (sizeof(mask.m) == 32 && lanes == 4) return _mm256_movemask_pd(reinterpret_cast<__m256d>(mask.m));
  if constexpr (sizeof(mask.m) == 32 && lanes == 8) return _mm256_movemask_ps(reinterpret_cast<__m256>(mask.m));
#endif
  unsigned found = 0;
  for (unsigned i = 0, bit = 1; i < lanes; ++i, bit += bit) {  // no shift: GCC's sanitizers get that wrong here
    if (mask.m[i] != 0) found += bit;
  }
  return found;
}
template <class M>
GELFLOW_INLINE auto is_set(const M& mask, int i) -> decltype(mask.m[i] != 0) {
  return mask.m[i] != 0;
}
template <class M>
GELFLOW_INLINE auto any(const M& mask) -> decltype(mask.m[0] != 0) {
  return bits(mask) != 0;
}
template <class T, int W>
GELFLOW_INLINE Lanes<T, W> sqrt(const Lanes<T, W>& x) {
  Lanes<T, W> root;
  for (int i = 0; i < W; ++i) root.v[i] = std::sqrt(x.v[i]);
  return root;
}

template <class T, int W>
GELFLOW_INLINE Lanes<T, W> abs(const Lanes<T, W>& x) {
  return select<T, W>(x < Lanes<T, W>(T(0)), -x, x);
}

// From and to neighbouring places of an array, which may hold numbers of another precision.
template <class L, class S>
GELFLOW_INLINE L load(const S* from) {
  if constexpr (lane_count<L> == 1) {
    return L(*from);
  } else {
    typedef S Stored __attribute__((vector_size(lane_count<L> * sizeof(S)), aligned(alignof(S))));
    return L(__builtin_convertvector(*reinterpret_cast<const Stored*>(from), typename L::Vector));
  }
}
template <class T>
GELFLOW_INLINE void store(const T& x, T* to) {
  *to = x;
}
template <class T, int W>
GELFLOW_INLINE void store(const Lanes<T, W>& x, T* to) {
  typedef T Stored __attribute__((vector_size(W * sizeof(T)), aligned(alignof(T))));
  *reinterpret_cast<Stored*>(to) = x.v;
}

// The first `count` lanes.
template <class L>
GELFLOW_INLINE Mask<L> first_lanes(int count) {
  if constexpr (lane_count<L> == 1) {
    return count > 0;
  } else {
    L number;
    for (int l = 0; l < lane_count<L>; ++l) number.v[l] = LaneScalar<L>(l);
    return number < L(LaneScalar<L>(count));
  }
}

// out[i] = Σ over the lanes of in[i].
template <class T>
GELFLOW_INLINE void sum_lanes(const T* in, int n, T* out) {
  std::copy(in, in + n, out);
}
template <class T, int W>
void sum_lanes(const Lanes<T, W>* in, int n, T* out) {
  using V = typename Lanes<T, W>::Vector;
  int i = 0;
  if constexpr (W == 4) {  // four sums side by side
    for (; i + 4 <= n; i += 4) {
      const V &a = in[i].v, &b = in[i + 1].v, &c = in[i + 2].v, &d = in[i + 3].v;
      const V ab = __builtin_shufflevector(a, b, 0, 4, 2, 6) + __builtin_shufflevector(a, b, 1, 5, 3, 7);
      const V cd = __builtin_shufflevector(c, d, 0, 4, 2, 6) + __builtin_shufflevector(c, d, 1, 5, 3, 7);
      const V left = __builtin_shufflevector(ab, cd, 0, 1, 4, 5), right = __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
      store(Lanes<T, W>(left + right), out + i);
    }
  }
  for (; i < n; ++i) out[i] = sum(in[i]);
}

// Numbers at one place of as many tables as there are lanes.
template <class L>
GELFLOW_INLINE L gather(const float* const* tables, std::ptrdiff_t at) {
  if constexpr (lane_count<L> == 1) {
    return L(tables[0][at]);
  } else {
    typename LaneShape<L>::Reading found;
    for (int l = 0; l < lane_count<L>; ++l) found[l] = tables[l][at];
    return L(__builtin_convertvector(found, typename L::Vector));
  }
}

template <class L>
struct Vec3 {
  L x, y, z;

  GELFLOW_INLINE L& operator[](int i) { return i == 0 ? x : i == 1 ? y : z; }
  GELFLOW_INLINE const L& operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
  GELFLOW_INLINE Vec3& operator+=(const Vec3& o) { return x += o.x, y += o.y, z += o.z, *this; }
  GELFLOW_INLINE Vec3& operator-=(const Vec3& o) { return x -= o.x, y -= o.y, z -= o.z, *this; }
  friend GELFLOW_INLINE Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
  friend GELFLOW_INLINE Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
  friend GELFLOW_INLINE Vec3 operator-(const Vec3& a) { return {-a.x, -a.y, -a.z}; }
  friend GELFLOW_INLINE Vec3 operator*(const L& s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
};

template <class L>
struct Mat3 {
  Vec3<L> row[3];

  Mat3() = default;
  GELFLOW_INLINE Mat3(const Vec3<L>& a, const Vec3<L>& b, const Vec3<L>& c) : row{a, b, c} {}
  // Written out, copies stay in registers; the compiler's own go through memory, in a loop.
  GELFLOW_INLINE Mat3(const Mat3& o) : row{o.row[0], o.row[1], o.row[2]} {}
  GELFLOW_INLINE Mat3& operator=(const Mat3& o) {
    for (int i = 0; i < 3; ++i) row[i] = o.row[i];
    return *this;
  }
  GELFLOW_INLINE Mat3& operator+=(const Mat3& o) {
    for (int i = 0; i < 3; ++i) row[i] += o.row[i];
    return *this;
  }
  GELFLOW_INLINE Mat3& operator-=(const Mat3& o) {
    for (int i = 0; i < 3; ++i) row[i] -= o.row[i];
    return *this;
  }
  friend GELFLOW_INLINE Mat3 operator+(Mat3 a, const Mat3& b) { return a += b; }
  friend GELFLOW_INLINE Mat3 operator-(Mat3 a, const Mat3& b) { return a -= b; }
  friend GELFLOW_INLINE Mat3 operator*(const L& s, const Mat3& a) { return {s * a.row[0], s * a.row[1], s * a.row[2]}; }
  friend GELFLOW_INLINE Vec3<L> operator*(const Mat3& a, const Vec3<L>& b) {
    return {dot(a.row[0], b), dot(a.row[1], b), dot(a.row[2], b)};
  }
};

template <class L>
GELFLOW_INLINE L dot(const Vec3<L>& a, const Vec3<L>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class L>
GELFLOW_INLINE Vec3<L> cross(const Vec3<L>& a, const Vec3<L>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class L>
GELFLOW_INLINE Mat3<L> outer(const Vec3<L>& a, const Vec3<L>& b) {  // a bᵀ
  return {a.x * b, a.y * b, a.z * b};
}
template <class L>
GELFLOW_INLINE Vec3<L> transposed_times(const Mat3<L>& a, const Vec3<L>& b) {
  return b.x * a.row[0] + b.y * a.row[1] + b.z * a.row[2];
}
template <class L>
GELFLOW_INLINE Mat3<L> identity_minus_outer(const Vec3<L>& n) {  // 1 − n nᵀ
  const L one(1.0);
  return {Vec3<L>{one - n.x * n.x, -n.x * n.y, -n.x * n.z}, Vec3<L>{-n.y * n.x, one - n.y * n.y, -n.y * n.z},
          Vec3<L>{-n.z * n.x, -n.z * n.y, one - n.z * n.z}};
}
// [x]× A and A [x]×.
template <class L>
GELFLOW_INLINE Mat3<L> cross_columns(const Vec3<L>& x, const Mat3<L>& a) {
  return {x.y * a.row[2] - x.z * a.row[1], x.z * a.row[0] - x.x * a.row[2], x.x * a.row[1] - x.y * a.row[0]};
}
template <class L>
GELFLOW_INLINE Mat3<L> cross_rows(const Mat3<L>& a, const Vec3<L>& x) {
  return {cross(a.row[0], x), cross(a.row[1], x), cross(a.row[2], x)};
}
template <class L>
GELFLOW_INLINE Vec3<L> select3(const Mask<L>& choice, const Vec3<L>& yes, const Vec3<L>& no) {
  return {select(choice, yes.x, no.x), select(choice, yes.y, no.y), select(choice, yes.z, no.z)};
}
template <class L>
GELFLOW_INLINE Vec3<L> zero3() {
  const L zero(0.0);
  return {zero, zero, zero};
}
template <class L>
GELFLOW_INLINE Mat3<L> zero33() {
  return {zero3<L>(), zero3<L>(), zero3<L>()};
}

// Between packs and the numbers of one body or one point.
template <class L, class T>
GELFLOW_INLINE Vec3<L> spread(const V3<T>& a) {
  return {L(a[0]), L(a[1]), L(a[2])};
}
template <class L, class T>
GELFLOW_INLINE Mat3<L> spread(const M3<T>& a) {
  return {Vec3<L>{L(a(0, 0)), L(a(0, 1)), L(a(0, 2))}, Vec3<L>{L(a(1, 0)), L(a(1, 1)), L(a(1, 2))},
          Vec3<L>{L(a(2, 0)), L(a(2, 1)), L(a(2, 2))}};
}
template <class T, class L>
GELFLOW_INLINE V3<T> lane3(const Vec3<L>& a, int i) {
  return {lane(a.x, i), lane(a.y, i), lane(a.z, i)};
}
template <class T, class L>
GELFLOW_INLINE void set_lane3(Vec3<L>& a, int i, const V3<T>& value) {
  set_lane(a.x, i, value[0]);
  set_lane(a.y, i, value[1]);
  set_lane(a.z, i, value[2]);
}
template <class T, class L>
GELFLOW_INLINE V3<T> sum3(const Vec3<L>& a) {
  return {sum(a.x), sum(a.y), sum(a.z)};
}

}  // namespace gelflow
