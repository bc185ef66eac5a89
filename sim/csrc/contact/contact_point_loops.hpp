// Loops over the contact points of a pair, one SIMD pack (contact_pack.hpp) at a time: over all points of a cloud in its
// order, or over the candidates of a step.
#pragma once

#include "contact/candidate_points.hpp"
#include "contact/contact_pack.hpp"

namespace gelflow {

// Ranges of points that may be in contact, in the order of the cloud; adjacent ones are merged.
struct CandidateRuns {
  PointRanges runs;
  int points = 0;
};
// The result is stored per thread and overwritten by the next call.
template <class T>
const CandidateRuns& candidate_runs(const PairFrame<T>& frame, const PointCloud& cloud, const T& reach) {
  thread_local CandidateRuns stored;
  CandidateRuns& candidates = stored;  // thread-local storage is looked up once
  candidates.runs.clear();
  candidates.points = 0;
  for_candidate_leaves<T>(frame, cloud, reach, [&](int begin, int end) {
    candidates.points += end - begin;
    if (!candidates.runs.empty() && candidates.runs.back().second == begin) {
      candidates.runs.back().second = end;
    } else {
      candidates.runs.emplace_back(begin, end);
    }
  });
  return candidates;
}

// Coordinates and weights of a cloud in the precision of T, padded with zeros.
template <class T>
struct CloudArrays {
  const double *x, *y, *z, *weights;
  explicit CloudArrays(const PointCloud& c)
      : x(c.points.x.data()), y(c.points.y.data()), z(c.points.z.data()), weights(c.weights.data()) {}
};
template <>
struct CloudArrays<float> {
  const float *x, *y, *z, *weights;
  explicit CloudArrays(const PointCloud& c)
      : x(c.rounded.x.data()), y(c.rounded.y.data()), z(c.rounded.z.data()), weights(c.rounded.weights.data()) {}
};

// Geometry of up to 16 packs of points. The first of two passes over them computes positions and distances, the second
// one forces: two short loops whose constants stay in registers.
template <bool with_hessian, class T>
struct GeometryBatch {
  using P = Pack<T>;
  static constexpr int capacity = 16;
  struct Entry {
    Vec3<P> x, n;
    P d, weight;  // weight: 0 where the point is not active
  };
  Entry entry[capacity];
  struct Curvature {  // only the member that the shape's HessianForm uses is written
    P curvature;
    Mat3<P> hessian;
  };
  Curvature curved[with_hessian ? capacity : 1];

  // Sets the points begin … end of the cloud. Returns the form of the shape's Hessian.
  GELFLOW_INLINE HessianForm compute(const PairFrame<T>& frame, const PairConstants<T>& pair,
                                     const CloudArrays<T>& arrays, int begin, int end) {
    HessianForm form{};
    with_distance<with_hessian, P, T>(frame.kind, frame.size, frame.grid, [&](auto&& distance_at) GELFLOW_LOOP_BODY {
      HessianForm shape_form{};  // a local variable of the loop stays in a register
      for (int i = begin, n = 0; i < end; i += pack_width<T>, ++n) {
        Entry& p = entry[n];
        Distance<P> at;
        const Vec3<P> x = pair.to_shape_frame({load<P>(arrays.x + i), load<P>(arrays.y + i), load<P>(arrays.z + i)});
        p.x.x = x.x, p.x.y = x.y, p.x.z = x.z;  // copied by component, the values stay in registers
        distance_at(x, at);
        p.d = at.d;
        p.n.x = at.n.x, p.n.y = at.n.y, p.n.z = at.n.z;
        p.weight = select(at.d < P(0.0), load<P>(arrays.weights + i), P(0.0));
        shape_form = at.form;
        if constexpr (with_hessian) {
          if (at.form == HessianForm::isotropic) {
            curved[n].curvature = at.curvature;
          } else if (at.form != HessianForm::zero) {
            curved[n].hessian = at.hessian;
          }
        }
      }
      form = shape_form;
    });
    return form;
  }

  // Replaces the weights of active points by those at the body's scale.
  GELFLOW_INLINE void scale_weights(const PairFrame<T>& frame, const PointCloud& cloud, int begin, int end) {
    for (int i = begin; i < std::min(end, cloud.size()); ++i) {
      Entry& p = entry[(i - begin) / pack_width<T>];
      const int k = (i - begin) % pack_width<T>;
      if (lane(p.weight, k) > T(0)) set_lane(p.weight, k, scaled_weight(frame, cloud, i));
    }
  }

  GELFLOW_INLINE void copy_to(int n, HessianForm form, const P& center_height, ContactPack<T>& t) const {
    const Entry& p = entry[n];
    t.x = p.x;
    t.center = {p.x.x, p.x.y, p.x.z + center_height};
    t.at.d = p.d;
    t.at.n = p.n;
    t.at.form = form;
    if constexpr (with_hessian) {
      if (form == HessianForm::isotropic) {
        t.at.curvature = curved[n].curvature;
      } else if (form != HessianForm::zero) {
        t.at.hessian = curved[n].hessian;
      }
    }
  }
};

// Anchors of the points from i on, which are consecutive in a cloud of `size`.
template <class T>
GELFLOW_INLINE void load_anchors(const ContactSettings<T>& settings, int i, int size, ContactPack<T>& t) {
  using P = Pack<T>;
  constexpr int width = pack_width<T>;
  T anchors[3][width] = {}, has_anchor[width] = {};
  if constexpr (has_fours<T>) {
    if (i + width <= size) {
      t.has_anchor = load<P>(settings.anchored + i) > P(0.0);
      t.anchor = load_vectors<T>(settings.anchors[i].data());  // one that is not set may have any value: it is masked
      return;
    }
  }
  for (int k = 0; k < width && i + k < size; ++k) {
    if (!settings.anchored[i + k]) continue;
    for (int a = 0; a < 3; ++a) anchors[a][k] = settings.anchors[i + k][a];
    has_anchor[k] = T(1);
  }
  t.anchor = {load<P>(anchors[0]), load<P>(anchors[1]), load<P>(anchors[2])};
  t.has_anchor = load<P>(has_anchor) > P(0.0);
}

// Calls f(pack) for the packs of these runs with active points, and skipped(begin, end) for all other points, in the
// order of the cloud.
template <bool with_hessian, bool elastic, class T, class F, class Skipped>
GELFLOW_INLINE void for_contact_points(const PairFrame<T>& frame, const PointCloud& cloud,
                                       const CandidateRuns& candidates, const ContactSettings<T>& settings, F&& f,
                                       Skipped&& skipped) {
  using P = Pack<T>;
  using Batch = GeometryBatch<with_hessian, T>;
  constexpr int width = pack_width<T>;
  Batch batch;
  HessianForm form{};
  const PairConstants<T> pair(frame, settings);
  const bool scales_weights = frame.scaled && !cloud.areas.empty();
  const CloudArrays<T> arrays(cloud);
  const auto visit_pack = [&](int i, int n) GELFLOW_LOOP_BODY {
    ContactPack<T> t;
    t.active = batch.entry[n].weight > P(0.0);
    if (!any(t.active)) return skipped(i, std::min(i + width, cloud.size()));
    t.has_anchor = first_lanes<P>(0);
    if constexpr (elastic) load_anchors<T>(settings, i, cloud.size(), t);
    t.first = i;
    batch.copy_to(n, form, pair.center_height, t);
    eval_contact<elastic, T>(pair, batch.entry[n].weight, t);
    f(static_cast<const ContactPack<T>&>(t));
  };
  int visited = 0;
  for (const auto& [first, last] : candidates.runs) {
    skipped(visited, first);
    visited = last;
    for (int begin = first; begin < last; begin += Batch::capacity * width) {
      const int end = std::min(begin + Batch::capacity * width, last);
      form = batch.compute(frame, pair, arrays, begin, end);
      if (scales_weights) batch.scale_weights(frame, cloud, begin, end);
      for (int i = begin, n = 0; i < end; i += width, ++n) visit_pack(i, n);
    }
  }
  skipped(visited, cloud.size());
}
template <bool with_hessian, class T, class F, class Skipped>
GELFLOW_INLINE void for_contact_points(const PairFrame<T>& frame, const PointCloud& cloud,
                                       const CandidateRuns& candidates, const ContactSettings<T>& settings, F&& f,
                                       Skipped&& skipped) {
  if (settings.law == FrictionLaw::elastic) {
    for_contact_points<with_hessian, true, T>(frame, cloud, candidates, settings, f, skipped);
  } else {
    for_contact_points<with_hessian, false, T>(frame, cloud, candidates, settings, f, skipped);
  }
}
template <bool with_hessian, class T, class F>
void for_contact_points(const PairFrame<T>& frame, const PointCloud& cloud, const ContactSettings<T>& settings, F&& f) {
  for_contact_points<with_hessian, T>(frame, cloud, candidate_runs<T>(frame, cloud, settings.rolling_radius), settings,
                                      f, [](int, int) {});
}

// Evaluates the pack of candidate points from i on. Returns whether any of them is active; `t` is incomplete otherwise.
template <bool with_hessian, class T>
GELFLOW_INLINE bool eval_candidates(const PairFrame<T>& frame, const PairConstants<T>& pair,
                                    const CandidatePoints<T>& candidates, int i, ContactPack<T>& t) {
  using P = Pack<T>;
  const Vec3<P> local{load<P>(&candidates.x[i]), load<P>(&candidates.y[i]), load<P>(&candidates.z[i])};
  const P weight = load<P>(&candidates.weight[i]);
  t.x = pair.to_shape_frame(local);
  t.center = {t.x.x, t.x.y, t.x.z + pair.center_height};
  distance<with_hessian>(frame.kind, frame.size, frame.grid, t.x, t.at);
  t.active = t.at.d < P(0.0) && weight > P(0.0);
  if (!any(t.active)) return false;
  t.has_anchor = first_lanes<P>(0);
  if (pair.elastic) {
    t.anchor = {load<P>(&candidates.anchor_x[i]), load<P>(&candidates.anchor_y[i]), load<P>(&candidates.anchor_z[i])};
    t.has_anchor = load<P>(&candidates.has_anchor[i]) > P(0.0);
  }
  t.first = i;
  t.index = &candidates.index[i];
  if (pair.elastic) {
    eval_contact<true, T>(pair, select(t.active, weight, P(0.0)), t);
  } else {
    eval_contact<false, T>(pair, select(t.active, weight, P(0.0)), t);
  }
  return true;
}

// Calls f(pack) for the packs of candidate points with active points.
template <bool with_hessian, class T, class F>
GELFLOW_INLINE void for_contact_points(const PairFrame<T>& frame, const CandidatePoints<T>& candidates,
                                       const ContactSettings<T>& settings, F&& f) {
  const PairConstants<T> pair(frame, settings);
  for (int i = 0; i < candidates.count; i += pack_width<T>) {
    ContactPack<T> t;
    if (eval_candidates<with_hessian, T>(frame, pair, candidates, i, t)) f(static_cast<const ContactPack<T>&>(t));
  }
}

}  // namespace gelflow
