// SIMD packs: W numbers in one register.
//
// The functions of a contact point are templates of a pack type P: a SimdPack of double or float in the simulator, a
// plain scalar for dual and taped numbers. A comparison returns a mask; both sides of a branch are evaluated and `select`
// chooses per lane. The implementation uses the vector extensions of GCC and Clang, which the compiler maps to the
// instructions of the target.
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
  GELFLOW_INLINE SimdPack(T value) : v(value - Vector{}) {}  // implicit, so that constants mix with packs

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

// The pack for scalars of type T: four doubles, eight floats, else one scalar.
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

// A scalar is a pack with one lane.
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
// The mask as an integer, one bit per lane; the first lane is the lowest bit.
GELFLOW_INLINE unsigned bits(bool x) { return x ? 1U : 0U; }
template <class M>
GELFLOW_INLINE auto bits(const M& mask) -> decltype(static_cast<unsigned>(mask.m[0])) {
  constexpr unsigned lanes = sizeof(mask.m) / sizeof(mask.m[0]);
#ifdef __AVX__
  if constexpr (sizeof(mask.m) == 32 && lanes == 4) return _mm256_movemask_pd(reinterpret_cast<__m256d>(mask.m));
  if constexpr (sizeof(mask.m) == 32 && lanes == 8) return _mm256_movemask_ps(reinterpret_cast<__m256>(mask.m));
#endif
  unsigned result = 0;
  for (unsigned i = 0, bit = 1; i < lanes; ++i, bit += bit) {  // no shift: GCC miscompiles it here under sanitizers
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

// Load from and store to consecutive elements of an array, which may be of another precision.
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

// Mask of the first `count` lanes.
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

// Horizontal sums: out[i] = Σ over the lanes of in[i].
template <class T>
GELFLOW_INLINE void sum_lanes(const T* in, int n, T* out) {
  std::copy(in, in + n, out);
}
template <class T, int W>
void sum_lanes(const SimdPack<T, W>* in, int n, T* out) {
  using V = typename SimdPack<T, W>::Vector;
  int i = 0;
  if constexpr (W == 4) {  // transposes four packs, for four sums at once
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

// Lane l of the result is tables[l][at].
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

}  // namespace gelflow
