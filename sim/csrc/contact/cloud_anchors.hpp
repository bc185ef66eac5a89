// Update of the anchors of one point cloud against one shape (contact_anchors.hpp: of all contacts of the model), and
// its vector-Jacobian product.
#pragma once

#include <cstring>

#include "contact/contact_point_loops.hpp"

namespace gelflow {

// Anchors of the points of a pack after a step.
template <class T>
GELFLOW_INLINE Vec3<Pack<T>> next_anchors(const ContactPack<T>& t, const T& step_length) {
  PointForce<Pack<T>> force;
  point_force<false>(t.law, t.at, t.v, t.e, t.has_anchor, force);
  return next_anchor(t.law, Pack<T>(step_length), force, t.x, t.anchor, t.has_anchor);
}

// `next` and `next_set` of the functions below are the arrays of `settings`, or copies of them: only what changes is
// written.

// Sets which of the points have an anchor after an accepted step, by the active packs of its last evaluation. Returns
// whether the anchor of any of them changes.
template <class T>
bool advance_anchored(const CandidatePoints<T>& candidates, int cloud_size, std::uint8_t* next_set) {
  std::fill(next_set, next_set + cloud_size, 0);
  unsigned moved = 0;
  for (int n = 0; n < candidates.active_count; ++n) {
    const ActivePack& pack = candidates.active_packs[n];
    const int* const index = &candidates.index[pack.first];
    for (unsigned lanes = pack.active; lanes != 0; lanes &= lanes - 1) next_set[index[std::countr_zero(lanes)]] = 1;
    moved |= pack.moved;
  }
  return moved != 0;
}

// Sets the anchors that change.
template <class T>
void advance_moved_anchors(const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                           const ContactSettings<T>& settings, V3<T>* next) {
  const PairConstants<T> pair(frame, settings);
  for (int n = 0; n < candidates.active_count; ++n) {
    const ActivePack& pack = candidates.active_packs[n];
    ContactPack<T> t;
    if (pack.moved == 0 || !eval_candidates<false, T>(frame, pair, candidates, pack.first, t)) continue;
    const Vec3<Pack<T>> anchor = next_anchors<T>(t, settings.step_length);
    for (unsigned lanes = pack.moved; lanes != 0; lanes &= lanes - 1) {
      const int k = std::countr_zero(lanes);
      next[t.index[k]] = lane3<T>(anchor, k);
    }
  }
}

// Clears the flags of the ranges `before` outside the ranges `now`; both are ascending.
inline void clear_outside(const PointRanges& before, const PointRanges& now, std::uint8_t* flags) {
  auto next = now.begin();
  for (auto [begin, end] : before) {
    while (next != now.end() && next->second <= begin) ++next;
    for (auto kept = next; begin < end; ++kept) {
      const int gap_end = kept == now.end() ? end : std::min(end, kept->first);
      if (gap_end > begin) std::memset(flags + begin, 0, gap_end - begin);
      begin = kept == now.end() ? end : kept->second;
    }
  }
}

// The anchors after an accepted step at all points of a cloud, without candidates of the step. `ranges` contains all
// points with an anchor, before and after.
template <class T>
void advance_anchors(const PairFrame<T>& frame, const PointCloud& cloud, const ContactSettings<T>& settings,
                     V3<T>* next, std::uint8_t* next_set, PointRanges& ranges) {
  constexpr unsigned whole_pack = (1U << pack_width<T>)-1;
  const auto advance = [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    const unsigned active = bits(t.active), anchored = bits(t.has_anchor);
    if (active != anchored) {
      for (int k = 0; k < std::min(pack_width<T>, cloud.size() - t.first); ++k) {
        next_set[t.first + k] = active >> k & 1U;
      }
    }
    PointForce<Pack<T>> force;
    point_force<false>(t.law, t.at, t.v, t.e, t.has_anchor, force);
    if (bits(t.active && (force.sliding || !t.has_anchor)) == 0) return;  // the usual case: all stick
    const Vec3<Pack<T>> anchor = next_anchor(t.law, Pack<T>(settings.step_length), force, t.x, t.anchor, t.has_anchor);
    if constexpr (has_fours<T>) {
      if (active == whole_pack) return store_vectors<T>(anchor, next[t.first].data());
    }
    t.for_each_active([&](int k, int i) { next[i] = lane3<T>(anchor, k); });
  };
  const CandidateRuns& candidates = candidate_runs<T>(frame, cloud, settings.rolling_radius);
  for_contact_points<false, true, T>(frame, cloud, candidates, settings, advance,
                                     [&](int begin, int end) GELFLOW_LOOP_BODY {
                                       if (end - begin > pack_width<T>) return;  // between runs
                                       for (int i = begin; i < end; ++i) next_set[i] = 0;
                                     });
  clear_outside(ranges, candidates.runs, next_set);
  ranges = candidates.runs;
}

// Vector-Jacobian product of `advance_anchors`: adds the gradients with respect to the relative pose, the relative twist
// and the anchors before the step.
template <class T, class Points>
void anchors_vjp(const PairFrame<T>& frame, const Points& points, const ContactSettings<T>& settings,
                 const V3<T>* grad_next, V6<T>& grad_pose, V6<T>& grad_twist, V3<T>* grad_anchor) {
  using P = Pack<T>;
  Vec3<P> rotation = zero3<P>(), translation = rotation, angular = rotation, linear = rotation;
  for_contact_points<true, T>(frame, points, settings, [&](const ContactPack<T>& t) {
    Vec3<P> lambda = zero3<P>();
    t.for_each_active([&](int k, int i) { set_lane3<T>(lambda, k, grad_next[i]); });
    const PointGradient<P> g = next_anchor_vjp(t.law, P(settings.step_length), t.at, t.v, t.e, t.has_anchor, lambda);
    const Vec3<P> grad_point = g.x - cross(broadcast<P>(frame.angular), g.v);
    rotation += cross(t.center, grad_point);
    translation += grad_point;
    angular += cross(t.x, g.v);
    linear += g.v;
    t.for_each_active([&](int k, int i) {
      if (is_set(t.has_anchor, k)) grad_anchor[i] += lane3<T>(g.anchor, k);
    });
  });
  grad_pose += stack<T>(sum3<T>(rotation), sum3<T>(translation));
  grad_twist += stack<T>(sum3<T>(angular), sum3<T>(linear));
}

}  // namespace gelflow
