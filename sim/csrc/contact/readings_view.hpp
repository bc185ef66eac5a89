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
  static constexpr bool packed = has_fours<T>;
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
