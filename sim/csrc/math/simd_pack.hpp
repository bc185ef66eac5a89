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
struct SimdPack {
  typedef T Vector __attribute__((vector_size(W * sizeof(T))));
  struct Mask {
    decltype(Vector() < Vector()) m;
    friend GELFLOW_INLINE Mask operator&&(const Mask& x, const Mask& y) { return {x.m & y.m}; }
    friend GELFLOW_INLINE Mask operator||(const Mask& x, const Mask& y) { return {x.m | y.m}; }
    friend GELFLOW_INLINE Mask operator!(const Mask& x) { return {~x.m}; }
  };
  Vector v;

  SimdPack() = default;
  GELFLOW_INLINE SimdPack(const Vector& values) : v(values) {}
  GELFLOW_INLINE SimdPack(T value) : v(value - Vector{}) {}  // implicit on purpose: constants mix freely with packs

  GELFLOW_INLINE SimdPack& operator+=(const SimdPack& o) { return v += o.v, *this; }
  GELFLOW_INLINE SimdPack& operator-=(const SimdPack& o) { return v -= o.v, *this; }
  GELFLOW_INLINE SimdPack& operator*=(const SimdPack& o) { return v *= o.v, *this; }
  friend GELFLOW_INLINE SimdPack operator+(const SimdPack& x, const SimdPack& y) { return x.v + y.v; }
  friend GELFLOW_INLINE SimdPack operator-(const SimdPack& x, const SimdPack& y) { return x.v - y.v; }
  friend GELFLOW_INLINE SimdPack operator*(const SimdPack& x, const SimdPack& y) { return x.v * y.v; }
  friend GELFLOW_INLINE SimdPack operator/(const SimdPack& x, const SimdPack& y) { return x.v / y.v; }
  friend GELFLOW_INLINE SimdPack operator-(const SimdPack& x) { return -x.v; }
  friend GELFLOW_INLINE Mask operator<(const SimdPack& x, const SimdPack& y) { return {x.v < y.v}; }
  friend GELFLOW_INLINE Mask operator>(const SimdPack& x, const SimdPack& y) { return {x.v > y.v}; }
};

// The lane type for numbers of type T: four doubles, eight floats.
template <class T>
struct NativePack {
  using Pack = T;
  using Mask = bool;
  static constexpr int width = 1;
};
template <>
struct NativePack<double> {
  using Pack = SimdPack<double, 4>;
  using Mask = Pack::Mask;
  static constexpr int width = 4;
};
template <>
struct NativePack<float> {
  using Pack = SimdPack<float, 8>;
  using Mask = Pack::Mask;
  static constexpr int width = 8;
};
template <class T>
using Pack = typename NativePack<T>::Pack;
template <class T>
constexpr int pack_width = NativePack<T>::width;

template <class P>
struct MaskOf {
  using type = bool;
};
template <class T, int W>
struct MaskOf<SimdPack<T, W>> {
  using type = typename SimdPack<T, W>::Mask;
};
template <class P>
using Mask = typename MaskOf<P>::type;

template <class P>
struct PackTraits {
  using Scalar = P;
  static constexpr int count = 1;
};
template <class T, int W>
struct PackTraits<SimdPack<T, W>> {
  typedef float FloatVector __attribute__((vector_size(W * sizeof(float))));
  using Scalar = T;
  static constexpr int count = W;
};
template <class P>
using PackScalar = typename PackTraits<P>::Scalar;
template <class P>
constexpr int lane_count = PackTraits<P>::count;

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
GELFLOW_INLINE SimdPack<T, W> select(const typename SimdPack<T, W>::Mask& choice, const SimdPack<T, W>& yes,
                                     const SimdPack<T, W>& no) {
  return choice.m ? yes.v : no.v;
}
template <class T, int W>
GELFLOW_INLINE T sum(const SimdPack<T, W>& x) {
  T total = x.v[0];
  for (int i = 1; i < W; ++i) total += x.v[i];
  return total;
}
template <class T, int W>
GELFLOW_INLINE T lane(const SimdPack<T, W>& x, int i) {
  return x.v[i];
}
template <class T, int W>
GELFLOW_INLINE void set_lane(SimdPack<T, W>& x, int i, const T& value) {
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
  unsigned result = 0;
  for (unsigned i = 0, bit = 1; i < lanes; ++i, bit += bit) {  // no shift: GCC's sanitizers get that wrong here
    if (mask.m[i] != 0) result += bit;
  }
  return result;
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
GELFLOW_INLINE SimdPack<T, W> sqrt(const SimdPack<T, W>& x) {
  SimdPack<T, W> root;
  for (int i = 0; i < W; ++i) root.v[i] = std::sqrt(x.v[i]);
  return root;
}

template <class T, int W>
GELFLOW_INLINE SimdPack<T, W> abs(const SimdPack<T, W>& x) {
  return select<T, W>(x < SimdPack<T, W>(T(0)), -x, x);
}

// From and to neighbouring places of an array, which may hold numbers of another precision.
template <class P, class S>
GELFLOW_INLINE P load(const S* from) {
  if constexpr (lane_count<P> == 1) {
    return P(*from);
  } else {
    typedef S Stored __attribute__((vector_size(lane_count<P> * sizeof(S)), aligned(alignof(S))));
    return P(__builtin_convertvector(*reinterpret_cast<const Stored*>(from), typename P::Vector));
  }
}
template <class T>
GELFLOW_INLINE void store(const T& x, T* to) {
  *to = x;
}
template <class T, int W>
GELFLOW_INLINE void store(const SimdPack<T, W>& x, T* to) {
  typedef T Stored __attribute__((vector_size(W * sizeof(T)), aligned(alignof(T))));
  *reinterpret_cast<Stored*>(to) = x.v;
}

// The first `count` lanes.
template <class P>
GELFLOW_INLINE Mask<P> first_lanes(int count) {
  if constexpr (lane_count<P> == 1) {
    return count > 0;
  } else {
    P number;
    for (int l = 0; l < lane_count<P>; ++l) number.v[l] = PackScalar<P>(l);
    return number < P(PackScalar<P>(count));
  }
}

// out[i] = Σ over the lanes of in[i].
template <class T>
GELFLOW_INLINE void sum_lanes(const T* in, int n, T* out) {
  std::copy(in, in + n, out);
}
template <class T, int W>
void sum_lanes(const SimdPack<T, W>* in, int n, T* out) {
  using V = typename SimdPack<T, W>::Vector;
  int i = 0;
  if constexpr (W == 4) {  // four sums side by side
    for (; i + 4 <= n; i += 4) {
      const V &a = in[i].v, &b = in[i + 1].v, &c = in[i + 2].v, &d = in[i + 3].v;
      const V ab = __builtin_shufflevector(a, b, 0, 4, 2, 6) + __builtin_shufflevector(a, b, 1, 5, 3, 7);
      const V cd = __builtin_shufflevector(c, d, 0, 4, 2, 6) + __builtin_shufflevector(c, d, 1, 5, 3, 7);
      const V left = __builtin_shufflevector(ab, cd, 0, 1, 4, 5), right = __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
      store(SimdPack<T, W>(left + right), out + i);
    }
  }
  for (; i < n; ++i) out[i] = sum(in[i]);
}

// Numbers at one place of as many tables as there are lanes.
template <class P>
GELFLOW_INLINE P gather(const float* const* tables, std::ptrdiff_t at) {
  if constexpr (lane_count<P> == 1) {
    return P(tables[0][at]);
  } else {
    typename PackTraits<P>::FloatVector result;
    for (int l = 0; l < lane_count<P>; ++l) result[l] = tables[l][at];
    return P(__builtin_convertvector(result, typename P::Vector));
  }
}

template <class P>
struct Vec3 {
  P x, y, z;

  GELFLOW_INLINE P& operator[](int i) { return i == 0 ? x : i == 1 ? y : z; }
  GELFLOW_INLINE const P& operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
  GELFLOW_INLINE Vec3& operator+=(const Vec3& o) { return x += o.x, y += o.y, z += o.z, *this; }
  GELFLOW_INLINE Vec3& operator-=(const Vec3& o) { return x -= o.x, y -= o.y, z -= o.z, *this; }
  friend GELFLOW_INLINE Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
  friend GELFLOW_INLINE Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
  friend GELFLOW_INLINE Vec3 operator-(const Vec3& a) { return {-a.x, -a.y, -a.z}; }
  friend GELFLOW_INLINE Vec3 operator*(const P& s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
};

template <class P>
struct Mat3 {
  Vec3<P> row[3];

  Mat3() = default;
  GELFLOW_INLINE Mat3(const Vec3<P>& a, const Vec3<P>& b, const Vec3<P>& c) : row{a, b, c} {}
  // DirtyMarkers out, copies stay in registers; the compiler's own go through memory, in a loop.
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
  friend GELFLOW_INLINE Mat3 operator*(const P& s, const Mat3& a) { return {s * a.row[0], s * a.row[1], s * a.row[2]}; }
  friend GELFLOW_INLINE Vec3<P> operator*(const Mat3& a, const Vec3<P>& b) {
    return {dot(a.row[0], b), dot(a.row[1], b), dot(a.row[2], b)};
  }
};

template <class P>
GELFLOW_INLINE P dot(const Vec3<P>& a, const Vec3<P>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class P>
GELFLOW_INLINE Vec3<P> cross(const Vec3<P>& a, const Vec3<P>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class P>
GELFLOW_INLINE Mat3<P> outer(const Vec3<P>& a, const Vec3<P>& b) {  // a bᵀ
  return {a.x * b, a.y * b, a.z * b};
}
template <class P>
GELFLOW_INLINE Vec3<P> transposed_times(const Mat3<P>& a, const Vec3<P>& b) {
  return b.x * a.row[0] + b.y * a.row[1] + b.z * a.row[2];
}
template <class P>
GELFLOW_INLINE Mat3<P> identity_minus_outer(const Vec3<P>& n) {  // 1 − n nᵀ
  const P one(1.0);
  return {Vec3<P>{one - n.x * n.x, -n.x * n.y, -n.x * n.z}, Vec3<P>{-n.y * n.x, one - n.y * n.y, -n.y * n.z},
          Vec3<P>{-n.z * n.x, -n.z * n.y, one - n.z * n.z}};
}
// [x]× A and A [x]×.
template <class P>
GELFLOW_INLINE Mat3<P> cross_columns(const Vec3<P>& x, const Mat3<P>& a) {
  return {x.y * a.row[2] - x.z * a.row[1], x.z * a.row[0] - x.x * a.row[2], x.x * a.row[1] - x.y * a.row[0]};
}
template <class P>
GELFLOW_INLINE Mat3<P> cross_rows(const Mat3<P>& a, const Vec3<P>& x) {
  return {cross(a.row[0], x), cross(a.row[1], x), cross(a.row[2], x)};
}
template <class P>
GELFLOW_INLINE Vec3<P> select3(const Mask<P>& choice, const Vec3<P>& yes, const Vec3<P>& no) {
  return {select(choice, yes.x, no.x), select(choice, yes.y, no.y), select(choice, yes.z, no.z)};
}
template <class P>
GELFLOW_INLINE Vec3<P> zero3() {
  const P zero(0.0);
  return {zero, zero, zero};
}
template <class P>
GELFLOW_INLINE Mat3<P> zero33() {
  return {zero3<P>(), zero3<P>(), zero3<P>()};
}

// Between packs and the numbers of one body or one point.
template <class P, class T>
GELFLOW_INLINE Vec3<P> broadcast(const V3<T>& a) {
  return {P(a[0]), P(a[1]), P(a[2])};
}
template <class P, class T>
GELFLOW_INLINE Mat3<P> broadcast(const M3<T>& a) {
  return {Vec3<P>{P(a(0, 0)), P(a(0, 1)), P(a(0, 2))}, Vec3<P>{P(a(1, 0)), P(a(1, 1)), P(a(1, 2))},
          Vec3<P>{P(a(2, 0)), P(a(2, 1)), P(a(2, 2))}};
}
template <class T, class P>
GELFLOW_INLINE V3<T> lane3(const Vec3<P>& a, int i) {
  return {lane(a.x, i), lane(a.y, i), lane(a.z, i)};
}
template <class T, class P>
GELFLOW_INLINE void set_lane3(Vec3<P>& a, int i, const V3<T>& value) {
  set_lane(a.x, i, value[0]);
  set_lane(a.y, i, value[1]);
  set_lane(a.z, i, value[2]);
}
template <class T, class P>
GELFLOW_INLINE V3<T> sum3(const Vec3<P>& a) {
  return {sum(a.x), sum(a.y), sum(a.z)};
}

}  // namespace gelflow
