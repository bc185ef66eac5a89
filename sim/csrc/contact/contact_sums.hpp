// Sums over the contact points of a pair, in the shape's frame: the wrench W on the first body (−W on the second), its
// stiffness K = ∂W/∂ξ and its damping D = ∂W/∂V, each 6 × 6.
//
// A point's displacement is ξ_lin + ξ_ang × c with c the point itself, or the sphere's centre for a rolling point. With
// A = ∂f/∂x including the change of the relative twist along the displacement, and B = ∂f/∂v:
//     D = Σ [x]×B | B   times  −[x]× | 1,      K = Σ [x]×A − [f]× | A   times  −[c]× | 1,     [f]×[c]× = c fᵀ − f·c
#pragma once

#include "contact/contact_point_loops.hpp"

namespace gelflow {

// W about the shape's origin, and with derivatives K and D. Moments come before forces, rotations before translations.
template <class T>
struct ContactSums {
  static constexpr int outer_at = 6, k_at = 15, d_at = 51, count = 87, padded = 88;
  T values[padded];  // W (6), Σ x fᵀ (9), K and D (36 each), padded to whole packs
  const T* wrench() const { return values; }
  T outer(int i, int j) const { return values[outer_at + 3 * i + j]; }
  T& k(int i, int j) { return values[k_at + 6 * i + j]; }
  T k(int i, int j) const { return values[k_at + 6 * i + j]; }
  T d(int i, int j) const { return values[d_at + 6 * i + j]; }
};

// Packs of points whose forces are computed but not yet summed.
template <class T>
struct ForceBuffer {
  using P = Pack<T>;
  static constexpr int capacity = 8;
  struct Entry {
    Vec3<P> x, force;
    Mat3<P> dforce_dpose, dforce_dv;  // A and B
  };
  int count = 0;
  Entry entry[capacity];
};

// Adds to a sum, or initializes it.
template <bool first, class P>
GELFLOW_INLINE void accumulate(const P& value, P& sum) {
  sum = first ? value : sum + value;
}

// Adds the terms of A (or B), the member `matrix` of all entries, to a 6 × 6 matrix; c = x + center_height ẑ. Each loop
// runs over all entries and keeps its few sums in registers.
template <bool first, class T>
GELFLOW_INLINE void add_blocks(const ForceBuffer<T>& buffer, Mat3<Pack<T>> ForceBuffer<T>::Entry::* matrix,
                               const T& center_height, Pack<T>* out) {
  using P = Pack<T>;
  const P up(center_height);
  for (int i = 0; i < 3; ++i) {
    Vec3<P> jac_rotation = zero3<P>(), jac_translation = jac_rotation;
    for (int n = 0; n < buffer.count; ++n) {
      const auto& e = buffer.entry[n];
      const Vec3<P>& row = (e.*matrix).row[i];
      jac_translation += row;
      jac_rotation += cross(Vec3<P>{e.x.x, e.x.y, e.x.z + up}, row);
    }
    for (int j = 0; j < 3; ++j) {
      accumulate<first>(jac_rotation[j], out[(3 + i) * 6 + j]);
      accumulate<first>(jac_translation[j], out[(3 + i) * 6 + 3 + j]);
    }
  }
  const auto moments = [&](int j, auto&& component) GELFLOW_LOOP_BODY {
    Vec3<P> jac_rotation = zero3<P>(), jac_translation = jac_rotation;
    for (int n = 0; n < buffer.count; ++n) {
      const auto& e = buffer.entry[n];
      const Mat3<P>& a = e.*matrix;
      const Vec3<P> c{e.x.x, e.x.y, e.x.z + up};
      jac_translation += cross(e.x, Vec3<P>{a.row[0][j], a.row[1][j], a.row[2][j]});
      jac_rotation += cross(e.x, Vec3<P>{component(c, a.row[0]), component(c, a.row[1]), component(c, a.row[2])});
    }
    for (int i = 0; i < 3; ++i) {
      accumulate<first>(jac_rotation[i], out[i * 6 + j]);
      accumulate<first>(jac_translation[i], out[i * 6 + 3 + j]);
    }
  };
  using V = Vec3<P>;
  moments(0, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.y * r.z - c.z * r.y; });
  moments(1, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.z * r.x - c.x * r.z; });
  moments(2, [](const V& c, const V& r) GELFLOW_LOOP_BODY { return c.x * r.y - c.y * r.x; });
}

// Adds all entries to the sums, which are laid out as in ContactSums, or initializes them; K without the terms of the
// forces themselves (add_force_stiffness).
template <bool first, bool derivatives, class T>
__attribute__((noinline)) void flush(ForceBuffer<T>& buffer, const T& center_height, Pack<T>* sums) {
  using P = Pack<T>;
  Vec3<P> force = zero3<P>(), moment = force;
  for (int n = 0; n < buffer.count; ++n) {
    const auto& e = buffer.entry[n];
    force += e.force;
    moment += cross(e.x, e.force);
  }
  for (int i = 0; i < 3; ++i) {
    accumulate<first>(moment[i], sums[i]);
    accumulate<first>(force[i], sums[3 + i]);
  }
  if constexpr (derivatives) {
    Mat3<P> outer_sum = zero33<P>();
    for (int n = 0; n < buffer.count; ++n) outer_sum += outer(buffer.entry[n].x, buffer.entry[n].force);
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) accumulate<first>(outer_sum.row[i][j], sums[ContactSums<T>::outer_at + 3 * i + j]);
    }
    add_blocks<first, T>(buffer, &ForceBuffer<T>::Entry::dforce_dpose, center_height, sums + ContactSums<T>::k_at);
    add_blocks<first, T>(buffer, &ForceBuffer<T>::Entry::dforce_dv, T(0), sums + ContactSums<T>::d_at);
  }
  buffer.count = 0;
}

// Adds the terms −[f]× and Σ c fᵀ − f·c of the forces to K.
template <class T>
GELFLOW_INLINE void add_force_stiffness(T center_height, ContactSums<T>& sums) {
  const T* const f = sums.wrench() + 3;
  const T trace = sums.outer(0, 0) + sums.outer(1, 1) + sums.outer(2, 2) + center_height * f[2];  // Σ f·c
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) sums.k(i, j) += sums.outer(i, j);
    sums.k(2, i) += center_height * f[i];
    sums.k(i, i) -= trace;
    const int j = (i + 1) % 3, k = (i + 2) % 3;  // −[f]×
    sums.k(j, 3 + k) += f[i];
    sums.k(k, 3 + j) -= f[i];
  }
}

// Sums over the candidate points. Returns whether any of them is active; `sums` is not written otherwise. Under the
// elastic law also lists the active packs.
template <bool derivatives, class T>
bool sum_forces(const PairFrame<T>& frame, CandidatePoints<T>& candidates, const ContactSettings<T>& settings,
                ContactSums<T>& sums) {
  using P = Pack<T>;
  constexpr int count = derivatives ? ContactSums<T>::count : 6, padded = derivatives ? ContactSums<T>::padded : 8;
  P total[padded];
  for (int i = count; i < padded; ++i) total[i] = P(0.0);
  bool any_active = false;
  candidates.active_count = 0;
  ForceBuffer<T> buffer;
  const auto flush_buffer = [&]() GELFLOW_LOOP_BODY {
    if (any_active) {
      flush<false, derivatives, T>(buffer, settings.rolling_radius, total);
    } else {
      flush<true, derivatives, T>(buffer, settings.rolling_radius, total);
    }
    any_active = true;
  };
  for_contact_points<derivatives, T>(frame, candidates, settings, [&](const ContactPack<T>& t) GELFLOW_LOOP_BODY {
    PointForce<P> force;
    point_force<derivatives>(t.law, t.at, t.v, t.e, t.has_anchor, force);
    if (t.law.elastic) {
      candidates.active_packs[candidates.active_count++] = {
          t.first, static_cast<std::uint8_t>(bits(t.active)),
          static_cast<std::uint8_t>(bits(t.active && (force.sliding || !t.has_anchor)))};
    }
    auto& e = buffer.entry[buffer.count++];
    e.x = t.x;
    e.force = force.force;
    if constexpr (derivatives) {
      e.dforce_dpose = force.dforce_dx + cross_rows(force.dforce_dv, broadcast<P>(frame.angular));
      e.dforce_dv = force.dforce_dv;
    }
    if (buffer.count == ForceBuffer<T>::capacity) flush_buffer();
  });
  if (buffer.count > 0) flush_buffer();
  if (!any_active) return false;
  sum_lanes(total, padded, sums.values);
  if constexpr (derivatives) add_force_stiffness<T>(settings.rolling_radius, sums);
  return true;
}

}  // namespace gelflow
