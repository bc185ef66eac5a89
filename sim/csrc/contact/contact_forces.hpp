// Generalized forces of the contacts and their derivatives, by the contact Jacobian of each pair.
#pragma once

#include <algorithm>

#include "contact/arc_correction.hpp"
#include "contact/contact_jacobian.hpp"
#include "contact/contact_sums.hpp"

namespace gelflow {

// Per column of the contact Jacobian: the changes K S + D Y and D S of the wrench, and S ×* W (contact_jacobian.hpp).
template <class T>
GELFLOW_INLINE void wrench_changes(const ContactSums<T>& sums, ContactJacobian<T>& c) {
  using P = Pack<T>;
  for (int i = 0; i < c.n; i += pack_width<T>) {
    P s[6], y[6];
    for (int a = 0; a < 6; ++a) {
      s[a] = load<P>(c.s.at(i, a));
      y[a] = load<P>(c.y.at(i, a));
    }
    for (int a = 0; a < 6; ++a) {
      P jac_q = P(sums.k(a, 0)) * s[0] + P(sums.d(a, 0)) * y[0], jac_v = P(sums.d(a, 0)) * s[0];
      for (int b = 1; b < 6; ++b) {
        const P d(sums.d(a, b));
        jac_q += P(sums.k(a, b)) * s[b] + d * y[b];
        jac_v += d * s[b];
      }
      store(jac_q, c.dwrench_dq.at(i, a));
      store(jac_v, c.dwrench_dv.at(i, a));
    }
    const T* const f = sums.wrench();
    const Vec3<P> angular{s[0], s[1], s[2]}, linear{s[3], s[4], s[5]}, moment{P(f[0]), P(f[1]), P(f[2])},
        force{P(f[3]), P(f[4]), P(f[5])};
    const Vec3<P> top = cross(angular, moment) + cross(linear, force), bottom = cross(angular, force);
    for (int a = 0; a < 3; ++a) {
      store(top[a], c.axis_wrench.at(i, a));
      store(bottom[a], c.axis_wrench.at(i, 3 + a));
    }
  }
}

// Subtracts row r of β h Sᵀ (K S + D Y), β h Sᵀ D S and the change of the axis from w.dg_dq and w.dg_dv.
// `first_component`: 3 for an axis without angular part; `coupled`: displacements of other dofs change the axis.
template <int first_component, bool coupled, class T>
GELFLOW_INLINE void subtract_row(const T& beta_h, int r, Workspace<T>& w) {
  using P = Pack<T>;
  constexpr int width = pack_width<T>;
  const ContactJacobian<T>& c = w.jacobian;
  const std::ptrdiff_t row = w.layout.row()[c.dofs->dof[r]];
  T *const dq = w.dg_dq.data() + row, *const dv = w.dg_dv.data() + row;
  P s[6];
  for (int a = first_component; a < 6; ++a) s[a] = P(T(beta_h * c.s.at(r - r % width, a)[r % width]));
  for (int i = 0; i < c.n; i += width) {
    P jac_q(0.0), jac_v(0.0), jac_axis(0.0);
    for (int a = first_component; a < 6; ++a) {
      jac_q += s[a] * load<P>(c.dwrench_dq.at(i, a));
      jac_v += s[a] * load<P>(c.dwrench_dv.at(i, a));
      if (coupled) jac_axis += s[a] * load<P>(c.axis_wrench.at(i, a));
    }
    if (coupled) jac_q -= load<P>(&c.dofs->axis_coupling[static_cast<std::size_t>(r) * c.n + i]) * jac_axis;
    const int at = c.matrix_column[i / width];
    store(load<P>(dq + at) - jac_q, dq + at);
    store(load<P>(dv + at) - jac_v, dv + at);
  }
}

// Subtracts β h · ∂(generalized forces of the pair)/∂(q, v) from w.dg_dq and w.dg_dv; w.jacobian is that of the pair.
template <class T>
void subtract_contact_derivatives(const T& beta_h, const ContactSums<T>& sums, Workspace<T>& w) {
  ContactJacobian<T>& c = w.jacobian;
  wrench_changes<T>(sums, c);
  for (int r = 0; r < c.n; ++r) {
    if (c.dofs->dof[r] < 0) continue;
    if (!c.dofs->linear[r]) {
      subtract_row<0, true, T>(beta_h, r, w);
    } else if (c.dofs->has_coupling[r]) {
      subtract_row<3, true, T>(beta_h, r, w);
    } else {
      subtract_row<3, false, T>(beta_h, r, w);
    }
  }
}

// Transforms a wrench about the shape's origin, in its frame, to one about the world's origin.
template <class T>
V6<T> wrench_in_world(const PairFrame<T>& frame, const T* wrench) {
  const V3<T> moment = frame.to_world * vec3(wrench), force = frame.to_world * vec3(wrench + 3);
  return stack<T>(moment + cross<T>(frame.origin, force), force);
}

// Subtracts the impulses β h Sᵀ W from w.residual. `add_impulses`: adds their absolute values to w.impulses.
template <class T>
void subtract_impulses(const PairDofs& pair, const T& beta_h, const V6<T>& wrench, bool add_impulses, Workspace<T>& w) {
  using std::abs;
  using P = Pack<T>;
  constexpr int width = pack_width<T>;
  const PackedDofs& dofs = pair.packed<width>();
  for (std::size_t n = 0; n < dofs.start.size(); ++n) {
    const int at = dofs.start[n];
    P sum = P(wrench[0]) * load<P>(w.axis.row(0) + at);
    for (int a = 1; a < 6; ++a) sum += P(wrench[a]) * load<P>(w.axis.row(a) + at);
    T impulse[width];
    store(P(beta_h) * load<P>(&dofs.sign[n * width]) * sum, impulse);
    for (int k = 0; k < width; ++k) {
      const int dof = dofs.dof[n * width + k];
      if (dof < 0) continue;
      w.residual[dof] -= impulse[k];
      if (add_impulses) w.impulses[dof] += abs(impulse[k]);
    }
  }
}

// Subtracts β h · (generalized contact forces) from w.residual; with derivatives also from w.dg_dq and w.dg_dv.
// `cache`: the state of the candidate points in w; with derivatives find_islands has found those of contacts that join
// trees. `add_impulses`: adds the absolute values to w.impulses.
template <bool derivatives, class T>
void subtract_contact_forces(const Model& m, const T* params, const StepStart<T>& start, CacheState cache,
                             bool add_impulses, Workspace<T>& w) {
  ContactSums<T> sums;
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    // The step length serves the arc correction only, under BDF1, where β h = h.
    ContactSettings<T> settings = contact_settings<T>(m, contact, params, start.anchors, start.anchored, start.beta_h);
    settings.continuation = start.continuation;
    const bool joins_trees = derivatives && contact.first_tree >= 0;
    if (!joins_trees) find_candidate_points<T>(frame, set.cloud, settings, cache, w.candidates[n]);
    if ((joins_trees && !w.layout.share_island(contact.first_tree, contact.second_tree)) ||
        !sum_forces<derivatives, T>(frame, w.candidates[n], settings, sums)) {
      w.candidates[n].active_count = 0;
      if (!is_finite(frame.finiteness_probe())) w.residual[0] = frame.finiteness_probe();
      continue;
    }
    subtract_impulses<T>(contact.pair, start.beta_h, wrench_in_world<T>(frame, sums.wrench()), add_impulses, w);
    if constexpr (derivatives) {
      contact_jacobian<T>(contact.pair, set.mount.body, frame, w);
      subtract_contact_derivatives<T>(start.beta_h, sums, w);
    }
    if (contact.uses_arc_correction && start.history == nullptr) {
      subtract_arc_correction<derivatives, T>(m, set.mount.body, frame, w.candidates[n], settings, w);
    }
  }
}

// Wrench of every contact on its first body, about the world's origin: (moment, force), shape (contacts, 6). Requires
// the kinematics of (q, v) in w.
template <class T>
void contact_wrenches(const Model& m, const T* params, const V3<T>* anchors, const std::uint8_t* anchored,
                      Workspace<T>& w, T* out) {
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    const ContactSettings<T> settings = contact_settings<T>(m, contact, params, anchors, anchored);
    ContactSums<T> sums;
    find_candidate_points<T>(frame, set.cloud, settings, CacheState::stale, w.candidates[n]);
    if (!sum_forces<false, T>(frame, w.candidates[n], settings, sums)) std::fill_n(sums.values, 6, T(0));
    const V6<T> in_world = wrench_in_world<T>(frame, sums.wrench());
    for (int i = 0; i < 6; ++i) out[6 * n + i] = in_world[i];
  }
}

}  // namespace gelflow
