// Vectors and matrices of three dimensions whose components are SIMD packs or scalars.
#pragma once

#include "math/simd_pack.hpp"

namespace gelflow {

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
  // Written out, copies stay in registers; the implicit copies are loops through memory.
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

// Conversions between packs and the vectors of one body (broadcast) or one point (lanes).
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

// Transposes four consecutive vectors x y z x y z … to one pack per component, and back.
template <class T>
GELFLOW_INLINE Vec3<SimdPack<T, 4>> load_threes(const T* from) {
  using P = SimdPack<T, 4>;
  const auto a = load<P>(from).v, b = load<P>(from + 4).v, c = load<P>(from + 8).v;
  const auto xy = __builtin_shufflevector(a, b, 0, 1, 6, 7), zx = __builtin_shufflevector(a, c, 2, 3, 4, 5),
             yz = __builtin_shufflevector(b, c, 0, 1, 6, 7);
  return {P(__builtin_shufflevector(xy, zx, 0, 5, 2, 7)), P(__builtin_shufflevector(xy, yz, 1, 4, 3, 6)),
          P(__builtin_shufflevector(zx, yz, 0, 5, 2, 7))};
}
template <class T>
GELFLOW_INLINE void store_threes(const Vec3<SimdPack<T, 4>>& a, T* to) {
  using P = SimdPack<T, 4>;
  const auto &x = a.x.v, &y = a.y.v, &z = a.z.v;
  const auto xy = __builtin_shufflevector(x, y, 0, 4, 2, 6), zx = __builtin_shufflevector(z, x, 0, 5, 2, 7),
             yz = __builtin_shufflevector(y, z, 1, 5, 3, 7);
  store(P(__builtin_shufflevector(xy, zx, 0, 1, 4, 5)), to);
  store(P(__builtin_shufflevector(yz, xy, 0, 1, 6, 7)), to + 4);
  store(P(__builtin_shufflevector(zx, yz, 2, 3, 6, 7)), to + 8);
}

// Four consecutive lanes of a pack.
template <class T>
GELFLOW_INLINE SimdPack<T, 4> four(const SimdPack<T, 4>& x, int) {
  return x;
}
template <class T>
GELFLOW_INLINE SimdPack<T, 4> four(const SimdPack<T, 8>& x, int first) {
  return first == 0 ? SimdPack<T, 4>(__builtin_shufflevector(x.v, x.v, 0, 1, 2, 3))
                    : SimdPack<T, 4>(__builtin_shufflevector(x.v, x.v, 4, 5, 6, 7));
}
template <class T>
GELFLOW_INLINE void set_four(SimdPack<T, 4>& x, int, const SimdPack<T, 4>& value) {
  x = value;
}
template <class T>
GELFLOW_INLINE void set_four(SimdPack<T, 8>& x, int first, const SimdPack<T, 4>& value) {
  const auto& v = value.v;
  const auto both = __builtin_shufflevector(v, v, 0, 1, 2, 3, 0, 1, 2, 3);
  x = first == 0 ? SimdPack<T, 8>(__builtin_shufflevector(both, x.v, 0, 1, 2, 3, 12, 13, 14, 15))
                 : SimdPack<T, 8>(__builtin_shufflevector(x.v, both, 0, 1, 2, 3, 12, 13, 14, 15));
}

// Whether a pack consists of whole fours.
template <class T>
inline constexpr bool has_fours = pack_width<T> % 4 == 0;

// As many consecutive vectors as a pack has lanes.
template <class T>
GELFLOW_INLINE Vec3<Pack<T>> load_vectors(const T* from) {
  Vec3<Pack<T>> vectors;
  for (int k = 0; k < pack_width<T>; k += 4) {
    const Vec3<SimdPack<T, 4>> part = load_threes<T>(from + 3 * k);
    for (int a = 0; a < 3; ++a) set_four(vectors[a], k, part[a]);
  }
  return vectors;
}
template <class T>
GELFLOW_INLINE void store_vectors(const Vec3<Pack<T>>& a, T* to) {
  for (int k = 0; k < pack_width<T>; k += 4) {
    store_threes<T>({four(a.x, k), four(a.y, k), four(a.z, k)}, to + 3 * k);
  }
}

}  // namespace gelflow
