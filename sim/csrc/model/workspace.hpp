// Memory for the intermediate results of one environment's step; allocated once, reused by each step.
#pragma once

#include <utility>
#include <vector>

#include "math/simd_pack.hpp"
#include "model/island_matrix.hpp"

namespace gelflow {

// Spatial vectors as structure of arrays: component a of all vectors in row a, padded for packs.
template <class T>
struct SixRows {
  explicit SixRows(int n) : stride_(n + PointCloud::padding), numbers_(6 * static_cast<std::size_t>(stride_), T(0)) {}
  T* row(int a) { return numbers_.data() + static_cast<std::size_t>(a) * stride_; }
  const T* row(int a) const { return numbers_.data() + static_cast<std::size_t>(a) * stride_; }
  V6<T> operator[](int i) const {
    V6<T> x;
    for (int a = 0; a < 6; ++a) x[a] = row(a)[i];
    return x;
  }
  void set(int i, const V6<T>& x) {
    for (int a = 0; a < 6; ++a) row(a)[i] = x[a];
  }

 private:
  int stride_;
  std::vector<T> numbers_;
};

// Spatial vectors as array of structures of packs: the six components of a pack are contiguous.
template <class T>
struct SixPacks {
  static constexpr int width = pack_width<T>;
  explicit SixPacks(int n) : numbers_(6 * static_cast<std::size_t>((n + width - 1) / width * width), T(0)) {}
  // Component a of the pack that begins with vector i.
  T* at(int i, int a) { return numbers_.data() + 6 * static_cast<std::ptrdiff_t>(i) + a * width; }
  const T* at(int i, int a) const { return numbers_.data() + 6 * static_cast<std::ptrdiff_t>(i) + a * width; }
  V6<T> operator[](int i) const {
    V6<T> x;
    for (int a = 0; a < 6; ++a) x[a] = at(i - i % width, a)[i % width];
    return x;
  }

 private:
  std::vector<T> numbers_;
};

// Inertia of a subtree about the world's origin (inverse_dynamics.hpp).
template <class T>
struct Composite {
  T mass;
  V3<T> moment;    // Σ m c
  M3<T> inertia;   // J
  M3<T> rate;      // B₁
  V3<T> momentum;  // linear momentum p
};

// State to which the candidate points in a workspace belong: possibly another environment; an earlier step of the same
// environment; the present step.
enum class CacheState : std::uint8_t { stale, warm, current };

// The pose and the margin around the shape at which candidate points were searched.
template <class T>
struct BroadPhaseQuery {
  M3<T> rotation;  // first body → shape
  V3<T> offset;
  double margin;  // [m]
};

// Ranges of the points of a cloud (begin, end), ascending.
using PointRanges = std::vector<std::pair<int, int>>;

// A pack of candidates with points in contact: from candidate `first` on, a bit per lane.
struct ActivePack {
  int first;
  std::uint8_t active;
  std::uint8_t moved;  // points whose anchor changes at the end of the step: new or sliding ones
};

// The points of one cloud that may touch one shape, as structure of arrays (broad_phase.hpp).
template <class T>
struct CandidatePoints {
  int count = 0, capacity = 0;
  int active_count = 0;
  std::vector<ActivePack> active_packs;                     // of the last evaluation of forces; elastic law
  std::vector<int> index;                                   // in the cloud
  std::vector<T> x, y, z, weight;                           // in the first body's frame
  std::vector<T> anchor_x, anchor_y, anchor_z, has_anchor;  // in the shape's frame; 1 where it is set; elastic law
  BroadPhaseQuery<T> query;
  // Points within a larger margin, among which the next steps search.
  std::vector<int> neighbors;
  std::vector<double> neighbor_x, neighbor_y, neighbor_z;
  BroadPhaseQuery<T> neighbor_query;
};

// Contact Jacobian of a pair in the shape's frame (contact_jacobian.hpp).
template <class T>
struct ContactJacobian {
  explicit ContactJacobian(int capacity)
      : s(capacity),
        y(capacity),
        dwrench_dq(capacity),
        dwrench_dv(capacity),
        axis_wrench(capacity),
        matrix_column(capacity) {}
  const PackedDofs* dofs = nullptr;
  int n = 0;         // columns, a whole number of packs
  SixPacks<T> s, y;  // S and Y, signs applied
  SixPacks<T> dwrench_dq, dwrench_dv,
      axis_wrench;                 // derivatives of the contact forces by the columns' dofs (contact_forces.hpp)
  std::vector<int> matrix_column;  // per pack: the column of its first dof in w.dg_dq and w.dg_dv
};

// The start of a step: the arguments of its residual other than v_t.
template <class T>
struct StepStart {
  T beta_h;  // β h, h the step length
  const T *q0, *v_star;
  const T* q_rounding;  // rounding residual of q0, or null (StateView)
  const T* history;     // δ and v_{t-2}; null under BDF1
  const V3<T>* anchors;
  const std::uint8_t* anchored;
  const T* u;
  CacheState cache = CacheState::stale;  // of the workspace
  // Continuation factor on k_t, k_s, the slope of dry friction and actuator gains; 1 except in Newton's homotopy.
  double continuation = 1;

  T length() const { return history == nullptr ? beta_h : T(beta_h * T(1.5)); }  // of the step itself
};

template <class T>
struct Workspace {
  explicit Workspace(const Model& m)
      : rotation(m.bodies.size()),
        position(m.bodies.size()),
        twist(m.bodies.size()),
        acceleration(m.bodies.size()),
        force(m.bodies.size()),
        composite(m.bodies.size()),
        axis(m.nv),
        twist_before(m.nv),
        twist_after(m.nv),
        acceleration_before(m.nv),
        p(m.nv),
        dmotion_dq(m.nv),
        dmotion_dv(m.nv),
        residual(m.nv + PointCloud::padding),
        impulses(m.nv + PointCloud::padding),
        residual_scale(m.nv + PointCloud::padding),
        increment(m.nv),
        generalized_acceleration(m.nv),
        velocity_change(m.nv),
        direction(m.nv),
        search_start(m.nv),
        best_velocity(m.nv),
        layout(m, pack_width<T>),
        mass(layout),
        dg_dq(layout),
        dg_dv(layout),
        dg_du(m.actuators.size()),
        tangent(layout),
        q(m.nq),
        pivots(m.nv),
        gathered(m.nv),
        solved(m.nv),
        jacobian(m.jacobian_columns),
        candidates(m.contacts.size()) {
    impulses.setZero();
    for (const Pad& pad : m.pads) anchored_markers.emplace_back(pad.shapes.size());
  }

  // Kinematics in the world frame; spatial vectors at the world's origin.
  std::vector<M3<PositionScalar<T>>> rotation;
  std::vector<V3<PositionScalar<T>>> position;
  std::vector<V6<T>> twist, acceleration, force;
  std::vector<Composite<T>> composite;  // of the subtree (inverse_dynamics.hpp)
  SixRows<T> axis;                      // S_k per dof
  SixRows<T> twist_before;              // before the dof's group
  std::vector<V6<T>> twist_after, acceleration_before;

  std::vector<V6<T>> p, dmotion_dq, dmotion_dv;  // P, Q and P − S × V_after per dof (inverse_dynamics.hpp)

  // Residual g of the step and its derivatives.
  VX<T> residual, impulses, residual_scale;  // padded with zeros (newton.hpp)
  VX<T> increment;                           // q_t = q_{t-1} ⊕ increment
  VX<T> generalized_acceleration;            // (v_t − v*)/(β h)
  VX<T> velocity_change;                     // v_t − v*
  VX<T> direction;                           // of Newton's method
  VX<T> search_start, best_velocity;         // start of the line search; iterate with the smallest residual
  IslandLayout layout;                       // of the matrices
  IslandMatrix<T> mass, dg_dq, dg_dv;        // ∂g/∂v* = −mass, ∂g/∂q_t, ∂g/∂v_t at fixed q_t
  VX<T> dg_du;                               // ∂g_dof/∂u per actuator
  IslandMatrix<T> tangent;  // ∂g/∂v_t in all: dg_dv + dg_dq ∂q_t/∂v_t; then its factors (linear_solver.hpp)
  VX<PositionScalar<T>> q;  // q_t of the trial velocity
  std::vector<int> pivots;
  VX<T> gathered, solved;  // of an island whose dofs are not consecutive (solver/islands.hpp)

  ContactJacobian<T> jacobian;                 // of the current pair
  std::vector<CandidatePoints<T>> candidates;  // per contact

  // Per pad and shape: ranges that contain all markers with an anchor, where `knows_anchored_markers`.
  std::vector<std::vector<PointRanges>> anchored_markers;
  bool knows_anchored_markers = false;  // the state is that of the last step

  // Applies a new layout. Entries of the mass matrix between trees or dofs without a common subtree stay 0 from then on.
  void fit_matrices(const Model& m) {
    if (!layout.apply(m)) return;
    for (IslandMatrix<T>* matrix : {&mass, &dg_dq, &dg_dv, &tangent}) matrix->fit(layout);
    mass.set_zero();
  }
};

}  // namespace gelflow
