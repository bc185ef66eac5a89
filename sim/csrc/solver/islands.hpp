// Finds the islands of a state (model/island_matrix.hpp) and solves linear systems island by island: the cost of a step
// grows with the sizes of the islands and not with the number of all dofs. Trees belong together where couplings,
// tendons or loop closures connect them, and where points of a contact between them are within reach.
//
// Islands are found in each evaluation with derivatives, by its state alone, so that results do not depend on earlier
// steps. Newton's method iterates on all islands together.
#pragma once

#include "contact/candidate_points.hpp"
#include "math/linear_solver.hpp"

namespace gelflow {

// Whether a point may touch the shape. Small clouds have all their points as candidates, so these are tested here.
template <class T>
bool has_point_in_reach(const PairFrame<T>& f, const PointCloud& cloud, const T& reach,
                        const CandidatePoints<T>& candidates) {
  if (cloud.size() > PointCloud::brute_force_size) return candidates.count > 0;
  bool found = false;
  const PointCloud::Coordinates& p = cloud.points;
  const auto test = [&](const auto& frame, const auto& limit) {
    for_points_in_reach(frame, p.x.data(), p.y.data(), p.z.data(), 0, cloud.size(), limit, [&](int) { found = true; });
  };
  if constexpr (std::is_floating_point_v<T>) {
    test(f, reach);
  } else {
    double size[3];
    test(value_frame(f, size), real_part(reach));
  }
  return found;
}

// Sets w.layout and the sizes of the matrices. Needs the kinematics in w, and finds the candidate points of the contacts
// that may join trees.
template <class T>
void find_islands(const Model& m, const T* params, const StepStart<T>& start, CacheState cache, Workspace<T>& w) {
  w.layout.separate(m);
  for (std::size_t n = 0; n < m.contacts.size(); ++n) {
    const Contact& contact = m.contacts[n];
    if (contact.first_tree < 0) continue;
    const PointSet& set = m.point_sets[contact.points];
    const PairFrame<T> frame = pair_frame<T>(params, set.mount, m.shapes[contact.shape], w);
    const ContactSettings<T> settings = contact_settings<T>(m, contact, params, start.anchors, start.anchored);
    find_candidate_points<T>(frame, set.cloud, settings, cache, w.candidates[n]);
    if (has_point_in_reach<T>(frame, set.cloud, settings.rolling_radius, w.candidates[n])) {
      w.layout.join(contact.first_tree, contact.second_tree);
    }
  }
  w.fit_matrices(m);
}

// Islands without contacts.
template <class T>
void find_coupled_islands(const Model& m, Workspace<T>& w) {
  if (!m.has_islands) return;
  w.layout.separate(m);
  w.fit_matrices(m);
}

// Copies the numbers of the dofs of an island to consecutive elements, and back.
template <class T>
void gather_island(const IslandLayout& layout, const Island& island, const T* of_dofs, T* of_island) {
  layout.for_ranges(island, [&](int begin, int size, int at) { std::copy_n(of_dofs + begin, size, of_island + at); });
}
template <class T>
void scatter_island(const IslandLayout& layout, const Island& island, const T* of_island, T* of_dofs) {
  layout.for_ranges(island, [&](int begin, int size, int at) { std::copy_n(of_island + at, size, of_dofs + begin); });
}

// Calls compute(island, in, out) with the numbers `x` of an island's dofs and memory for those of the result `y`.
template <class T, class Compute>
void for_each_island(Workspace<T>& w, const T* x, T* y, Compute&& compute) {
  for (const Island& island : w.layout.islands()) {
    const int first = w.layout.consecutive_from(island);
    if (first >= 0) {
      compute(island, x + first, y + first);
      continue;
    }
    gather_island(w.layout, island, x, w.gathered.data());
    compute(island, w.gathered.data(), w.solved.data());
    scatter_island(w.layout, island, w.solved.data(), y);
  }
}

// Factorizes w.tangent for solve_tangent.
template <class T>
void factorize_tangent(Workspace<T>& w) {
  for (const Island& island : w.layout.islands()) {
    auto block = w.tangent.block(island);
    factorize<T>(block, island.size, w.pivots.data() + island.first);
  }
}

// x = A⁻¹ b with A the factorized w.tangent.
template <class T>
GELFLOW_INLINE void solve_tangent(Workspace<T>& w, const VX<T>& b, VX<T>& x) {
  const auto solve_island = [&w](const Island& island, const T* rhs, T* solution) GELFLOW_LOOP_BODY {
    solve<T>(w.tangent.block(island), island.size, w.pivots.data() + island.first, rhs, solution);
  };
  if (w.layout.islands().size() == 1) return solve_island(w.layout.islands().front(), b.data(), x.data());
  for_each_island<T>(w, b.data(), x.data(), solve_island);
}

template <class T>
void transpose_tangent(Workspace<T>& w) {
  for (const Island& island : w.layout.islands()) w.tangent.block(island).transposeInPlace();
}

// Aᵀ x.
template <class T>
VX<T> transposed_times(Workspace<T>& w, const IslandMatrix<T>& a, const VX<T>& x) {
  VX<T> result(x.size());
  for_each_island<T>(w, x.data(), result.data(), [&](const Island& island, const T* in, T* out) {
    Eigen::Map<VX<T>>(out, island.size).noalias() =
        a.block(island).transpose() * Eigen::Map<const VX<T>>(in, island.size);
  });
  return result;
}

}  // namespace gelflow
