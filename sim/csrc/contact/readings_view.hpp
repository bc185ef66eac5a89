// Access to marker readings by packs, in the order of the scene, and the bookkeeping of readings that are not zero.
#pragma once

#include <bit>

#include "contact/contact_pack.hpp"

namespace gelflow {

// Which readings in an array may differ from zero: all, or those of these markers. Usually few markers are in contact;
// clearing the whole array would cost more than reading them.
struct NonzeroMarkers {
  bool all = true;
  bool track = true;  // whether the next reading lists its markers: not after one with many of them
  std::vector<int> markers;
};

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

// Access to the readings of one pad in an array (markers, 3) in the order of the scene, by index in the sorted cloud.
template <class T, class Number>
class ReadingsView {
 public:
  using P = Pack<T>;
  ReadingsView(const Pad& pad, Number* all)
      : original_(pad.cloud.original.data()), numbers_(all + 3 * static_cast<std::ptrdiff_t>(pad.first_marker)) {}

  Number* operator[](int i) const { return at(original_[i]); }  // of marker i of the cloud

  // Readings of the markers first + k of the cloud, for each bit k of `lanes`: those of other lanes are read as 0 and
  // not written.
  GELFLOW_INLINE Vec3<P> read(int first, unsigned lanes) const {
    Vec3<P> values = zero3<P>();
    if constexpr (packed) {
      for_fours(first, lanes, [&](int k, Number* from) GELFLOW_LOOP_BODY {
        const Vec3<SimdPack<T, 4>> part = load_threes<T>(from);
        for (int a = 0; a < 3; ++a) set_four(values[a], k, part[a]);
      });
    }
    for (; lanes != 0; lanes &= lanes - 1) {
      const int k = std::countr_zero(lanes);
      set_lane3<T>(values, k, Eigen::Map<const V3<T>>((*this)[first + k]));
    }
    return values;
  }
  GELFLOW_INLINE void write(int first, unsigned lanes, const Vec3<P>& values) const {
    if constexpr (packed) {
      for_fours(first, lanes, [&](int k, Number* to) GELFLOW_LOOP_BODY {
        store_threes<T>({four(values.x, k), four(values.y, k), four(values.z, k)}, to);
      });
    }
    if (lanes == 0) return;
    T components[3][pack_width<T>];
    for (int a = 0; a < 3; ++a) store(values[a], components[a]);
    for (; lanes != 0; lanes &= lanes - 1) {
      const int k = std::countr_zero(lanes);
      Number* const to = (*this)[first + k];
      for (int a = 0; a < 3; ++a) to[a] = components[a][k];
    }
  }
  void clear(int begin, int end) const {
    for (int i = begin; i < end; ++i) std::fill_n((*this)[i], 3, T(0));
  }
  void clear_all(int markers) const { std::fill_n(numbers_, 3 * static_cast<std::ptrdiff_t>(markers), T(0)); }

 private:
  static constexpr bool packed = pack_width<T> % 4 == 0;
  Number* at(int marker) const { return numbers_ + 3 * static_cast<std::ptrdiff_t>(marker); }

  // Calls f(k, readings) for groups of four that are consecutive in the scene's order too, and removes them from `lanes`.
  template <class F>
  GELFLOW_INLINE void for_fours(int first, unsigned& lanes, F&& f) const {
    for (int k = 0; k < pack_width<T>; k += 4) {
      const int* const original = original_ + first + k;  // ascending
      if (((lanes >> k) & 15U) != 15U || original[3] - original[0] != 3) continue;
      f(k, at(original[0]));
      lanes &= ~(15U << k);
    }
  }
  const int* original_;
  Number* numbers_;
};

// Adds forces to the readings of a curved pad, in the frame of each marker: first + k for each bit k of `lanes`.
template <class T>
__attribute__((noinline)) void add_to_curved_pad(const Pad& pad, const PairFrame<T>& frame, int first, unsigned lanes,
                                                 const Vec3<Pack<T>>& force, const ReadingsView<T, T>& readings) {
  const Vec3<Pack<T>> in_body = transposed_times(broadcast<Pack<T>>(frame.rotation), force);
  for (; lanes != 0; lanes &= lanes - 1) {
    const int k = std::countr_zero(lanes);
    const V3<T> reading_force = pad.frames[first + k].transpose().template cast<T>() * lane3<T>(in_body, k);
    T* const reading = readings[first + k];
    reading[0] += reading_force[0];
    reading[1] += reading_force[1];
    reading[2] -= reading_force[2];
  }
}
// Forces given in the markers' frames, in the shape's frame.
template <class T>
__attribute__((noinline)) Vec3<Pack<T>> from_curved_pad(const Pad& pad, const PairFrame<T>& frame, int first,
                                                        unsigned lanes, const Vec3<Pack<T>>& marker_force) {
  Vec3<Pack<T>> in_body = zero3<Pack<T>>();
  for (; lanes != 0; lanes &= lanes - 1) {
    const int k = std::countr_zero(lanes);
    set_lane3<T>(in_body, k, pad.frames[first + k].template cast<T>() * lane3<T>(marker_force, k));
  }
  return broadcast<Pack<T>>(frame.rotation) * in_body;
}

// Clears what an earlier reading has written, and lists the active markers of a new one. `nonzero` may be null: then the
// array has unknown contents.
template <class T>
class NonzeroTracker {
 public:
  NonzeroTracker(const Model& m, T* out, NonzeroMarkers* nonzero)
      : nonzero_(nonzero), track_(nonzero != nullptr && nonzero->track), max_tracked_(m.num_markers / 8) {
    if (nonzero == nullptr) return;
    for (const int marker : nonzero->markers) std::fill_n(out + 3 * static_cast<std::size_t>(marker), 3, T(0));
    nonzero->markers.clear();
    if (track_) nonzero->markers.reserve(static_cast<std::size_t>(max_tracked_) + pack_width<T>);
  }
  // Whether the readings that are not listed may differ from zero.
  bool must_clear() const { return nonzero_ == nullptr || nonzero_->all; }
  GELFLOW_INLINE void add(const Pad& pad, const ContactPack<T>& t, unsigned active) {
    count_ += std::popcount(active);
    if (!track_ || count_ > max_tracked_) return;
    t.for_each_active([&](int, int i) { nonzero_->markers.push_back(pad.first_marker + pad.cloud.original[i]); });
  }
  void finish() {
    if (nonzero_ == nullptr) return;
    nonzero_->track = count_ <= max_tracked_;
    nonzero_->all = !track_ || !nonzero_->track;
  }

 private:
  NonzeroMarkers* const nonzero_;
  const bool track_;
  const int max_tracked_;
  int count_ = 0;
};

}  // namespace gelflow
