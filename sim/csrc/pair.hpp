// One ordered pair: points of a first body in the frame of a shape on a second body; and how what is felt there acts
// on the joints.
//
// In the shape's frame everything depends on the relative pose and the relative twist V = V₁ − V₂ only. For the dofs
// that move one of the two bodies (sign s = +1 the first, −1 the second), written in the shape's frame,
//     displacement of the first body relative to the second   δξ = Σ s_j S_j δq_j
//     change of the relative twist                            δV = Σ s_j (Y_j δq_j + S_j δv_j),  Y_j = S_j × (V₁ − V_before(j))
//     ∂S_k/∂q_j · W = c_kj S_k · (S_j ×* W)   with c = −1 if both move the first body and j carries k, +1 if k moves the
//                     first and j the second, +1 if both move the second and j does not carry k, else 0.
#pragma once

#include <type_traits>

#include "contact_law.hpp"
#include "kinematics.hpp"

namespace gelflow {

template <class T>
struct PairFrame {
  M3<T> rotation;         // first body → shape
  V3<T> offset;           // origin of the first body, in the shape's frame
  M3<T> to_world;         // shape → world
  V3<T> origin;           // of the shape, in the world
  V3<T> angular, linear;  // V, at the shape's origin
  const T* size;
  const DistanceGrid* grid;
  ShapeKind kind;
  V3<T> local;    // in the first body's frame: a sphere's centre, a plane's normal
  T local_level;  // height of the first body's origin above a plane
  // Where the points are scaled (then `rotation` holds that too):
  bool scaled;
  T stretch;       // the largest scale
  V3<T> enlarged;  // by how much faces across x, y, z are larger, less 1

  // Whether a point of the first body may be nearer to the shape than `reach`. May say yes to one that just is not; costs
  // less than the point's place in the shape's frame.
  template <bool scaled>
  GELFLOW_INLINE bool may_reach(const V3<double>& center, const T& reach) const {
    const V3<T> c = center.template cast<T>();
    if (!scaled && kind == ShapeKind::sphere) {
      const T limit = size[0] + reach;
      return (c - local).squaredNorm() < limit * limit;
    }
    if (kind == ShapeKind::plane) return local.dot(c) + local_level < reach;
    return distance_only<T>(kind, size, grid, point(center)) < reach;
  }

  // Not finite where a parameter is not: then no point touches, and that must not pass for no contact.
  T check() const {
    const bool rounded = kind == ShapeKind::rounded_box || kind == ShapeKind::rounded_cylinder;
    return offset[0] + offset[1] + offset[2] + size[0] + size[1] + size[2] + (rounded ? size[3] : T(0));
  }

  GELFLOW_INLINE V3<T> point(const V3<double>& local) const { return rotation * local.template cast<T>() + offset; }
  GELFLOW_INLINE V3<T> velocity(const V3<T>& x) const { return linear + cross<T>(angular, x); }
  GELFLOW_INLINE V6<T> motion(const V6<T>& in_world) const {
    const V3<T> w = top(in_world), v = bottom(in_world);
    return stack<T>(to_world.transpose() * w, to_world.transpose() * (v + cross<T>(w, origin)));
  }
};

// Whether these numbers are others than the nominal ones. Numbers that carry derivatives always are.
template <class T>
GELFLOW_INLINE bool differs(const T* numbers, const V3<double>& nominal) {
  if constexpr (!std::is_floating_point_v<T>) return true;
  return numbers[0] != T(nominal[0]) || numbers[1] != T(nominal[1]) || numbers[2] != T(nominal[2]);
}

template <class T>
M3<T> turn_of(const T* turn) {
  return rotation_of<T>(quaternion_exp<T>(vec3(turn)));
}

// With R, p the nominal frame in the body and Params' place p', turn φ, scale S, a point x of the body moves to
//     x' = p' + R exp(φ) S Rᵀ (x − p) = A x + b,    A − 1 = R (exp(φ) S − 1) Rᵀ,    b = (p' − p) − (A − 1) p
// (written so that nothing is rounded where nothing moves): the body's pose ∘ (A, b) takes the body's place.
template <class T>
__attribute__((noinline)) void move_mount(const T* place, const Mount& mount, M3<T>& rotation, V3<T>& position,
                                          PairFrame<T>& f) {
  const M3<T> r = mount.rotation.template cast<T>();
  const V3<T> p = mount.pos.template cast<T>();
  M3<T> change = turn_of<T>(place + 3);
  if (mount.scales) {
    const T* s = place + 6;
    for (int a = 0; a < 3; ++a) change.col(a) *= s[a];
    f.scaled = !std::is_floating_point_v<T> || differs<T>(s, V3<double>::Ones());
    f.stretch = std::max({s[0], s[1], s[2]});
    f.enlarged = V3<T>(s[1] * s[2] - T(1), s[2] * s[0] - T(1), s[0] * s[1] - T(1));
  }
  change -= M3<T>::Identity();
  change = (r * change * r.transpose()).eval();
  position += rotation * V3<T>(vec3(place) - p - change * p);
  rotation += (rotation * change).eval();
}

template <class T>
PairFrame<T> pair_frame(const T* params, const Mount& mount, const Shape& shape, const Workspace<T>& w) {
  PairFrame<T> f;
  const int first = mount.body;
  f.kind = shape.kind;
  f.size = params + shape.size;
  f.grid = shape.grid.get();
  f.to_world = shape.rotation.template cast<T>();
  if (differs<T>(params + shape.place + 3, V3<double>::Zero())) {
    f.to_world = (f.to_world * turn_of<T>(params + shape.place + 3)).eval();
  }
  f.origin = vec3(params + shape.place);
  V6<T> twist = first == world ? V6<T>(V6<T>::Zero()) : w.twist[first];
  if (shape.body != world) {
    f.origin = (w.position[shape.body] + w.rotation[shape.body] * f.origin).eval();
    f.to_world = (w.rotation[shape.body] * f.to_world).eval();
    twist -= w.twist[shape.body];
  }
  M3<T> first_rotation = first == world ? M3<T>(M3<T>::Identity()) : w.rotation[first];
  V3<T> first_position = first == world ? V3<T>(V3<T>::Zero()) : w.position[first];
  f.scaled = false;
  const T* place = params + mount.place;
  if (differs<T>(place, mount.pos) || differs<T>(place + 3, V3<double>::Zero()) ||
      (mount.scales && differs<T>(place + 6, V3<double>::Ones()))) {
    move_mount<T>(place, mount, first_rotation, first_position, f);
  }
  f.rotation = f.to_world.transpose() * first_rotation;
  f.offset = f.to_world.transpose() * (first_position - f.origin);
  f.local =
      shape.kind == ShapeKind::plane ? V3<T>(f.rotation.transpose().col(2)) : V3<T>(f.rotation.transpose() * -f.offset);
  f.local_level = f.offset[2];
  const V6<T> local = f.motion(twist);
  f.angular = top(local);
  f.linear = bottom(local);
  return f;
}

// Calls visit(i) for every point that may be inside the shape grown by `margin`.
template <bool scaled, class T, class Visit>
GELFLOW_INLINE void for_near_points(const PairFrame<T>& f, const PointCloud& cloud, const T& margin, Visit&& visit) {
  const T around = margin + T(1e-6);  // [m], above the rounding of single precision
  const auto reach = [&](double radius) { return (scaled ? T(radius) * f.stretch : T(radius)) + around; };
  for (const auto& group : cloud.groups) {
    if (!f.template may_reach<scaled>(group.center, reach(group.radius))) continue;
    for (int l = group.begin; l < group.end; ++l) {
      const auto& leaf = cloud.leaves[l];
      if (!f.template may_reach<scaled>(leaf.center, reach(leaf.radius))) continue;
      for (int i = leaf.begin; i < leaf.end; ++i) {
        if (f.template may_reach<scaled>(cloud.points[i], around)) visit(i);
      }
    }
  }
}
template <class T, class Visit>
GELFLOW_INLINE void for_near_points(const PairFrame<T>& f, const PointCloud& cloud, const T& margin, Visit&& visit) {
  if constexpr (std::is_floating_point_v<T>) {
    if (f.scaled) return for_near_points<true, T>(f, cloud, margin, visit);
    return for_near_points<false, T>(f, cloud, margin, visit);
  } else {  // what is near is no matter of derivatives
    const double size[3] = {real_part(f.size[0]), real_part(f.size[1]), real_part(f.size[2])};
    PairFrame<double> real;
    real.size = size;
    real.kind = f.kind;
    real.grid = f.grid;
    real.stretch = f.scaled ? real_part(f.stretch) : 1.0;
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) real.rotation(i, j) = real_part(f.rotation(i, j));
      real.offset[i] = real_part(f.offset[i]);
      real.local[i] = real_part(f.local[i]);
    }
    real.local_level = real_part(f.local_level);
    for_near_points<true, double>(real, cloud, real_part(margin), visit);
  }
}

// Up to pack_width points that are looked at together; `inside` tells which of them touch.
template <class T>
struct Touching {
  using L = Pack<T>;
  int count = 0;
  int index[pack_width<T>];  // in the cloud's order
  Mask<L> inside;
  PointLaw<L> law;  // of weight 0 where a point does not touch
  Distance<L> at;
  Vec3<L> center, x;  // the point itself, or the centre of a rolling sphere; the point that touches
  Vec3<L> v;          // relative to the shape
  Vec3<L> anchor, e;
  Mask<L> remembers;  // has an anchor

  template <class F>
  GELFLOW_INLINE void for_each_inside(F&& f) const {
    for (int k = 0; k < count; ++k) {
      if (is_set(inside, k)) f(k, index[k]);
    }
  }
};

// What the points of one cloud need besides their places.
template <class T>
struct TouchRule {
  const T* params;  // kn, kt, mu, kd, ks
  FrictionLaw law;
  DampingLaw damping;
  T rolling_radius;              // 0: the points themselves touch
  const V3<T>* anchors;          // of this cloud against this shape
  const std::uint8_t* anchored;  // both unused under the viscous law
  double softness = 1;           // share of k_t and k_s that is at work
};

template <class T>
GELFLOW_INLINE PointLaw<Pack<T>> weighted(const TouchRule<T>& rule, const Pack<T>& weight) {
  using L = Pack<T>;
  const T* p = rule.params;
  const bool elastic = rule.law == FrictionLaw::elastic;
  const L none(0.0);  // rounding: set where it is needed
  const L share(T(rule.softness));
  return {weight * L(p[0]),
          share * weight * L(p[1]),
          L(p[2]),
          weight * L(p[3]),
          share * weight * L(p[4]),
          none,
          rule.damping,
          elastic};
}

// Calls f(touching) for all points that are inside the shape, a pack at a time.
template <class T, class F>
void for_touching_points(const PairFrame<T>& frame, const PointCloud& cloud, const TouchRule<T>& rule, F&& f) {
  using L = Pack<T>;
  using std::abs;
  constexpr int width = pack_width<T>;
  Touching<T> t;
  const bool elastic = rule.law == FrictionLaw::elastic, weighs = frame.scaled && !cloud.areas.empty();
  const auto flush = [&]() __attribute__((noinline)) {
    L weight(0.0), remembers(0.0);
    Vec3<L> local = zero3<L>();
    t.anchor = zero3<L>();
    for (int k = 0; k < width; ++k) {
      const int i = t.index[k < t.count ? k : 0];
      set_lane3<T>(local, k, cloud.points[i].template cast<T>());
      set_lane(weight, k, k < t.count ? T(cloud.weights[i]) : T(0));
      if (weighs && k < t.count) {
        set_lane(weight, k, T(T(cloud.weights[i]) + frame.enlarged.dot(cloud.areas[i].template cast<T>())));
      }
      if (elastic && rule.anchored[i]) {
        set_lane3<T>(t.anchor, k, rule.anchors[i]);
        set_lane(remembers, k, T(1));
      }
    }
    t.x = t.center = spread<L>(frame.rotation) * local + spread<L>(frame.offset);
    if (rule.rolling_radius > T(0)) t.x.z -= L(rule.rolling_radius);  // planes only: n = z
    distance<L>(frame.kind, frame.size, frame.grid, t.x, t.at);
    t.inside = t.at.d < L(0.0) && weight > L(0.0);
    if (any(t.inside)) {
      t.law = weighted<T>(rule, select(t.inside, weight, L(0.0)));
      t.v = spread<L>(frame.linear) + cross(spread<L>(frame.angular), t.x);
      t.remembers = remembers > L(0.0);
      if (elastic) {
        const L size = abs(t.x.x) + abs(t.x.y) + abs(t.x.z);
        t.law.rounding = L(T(4 * real_part(Eigen::NumTraits<T>::epsilon()))) * size;
      }
      t.e = select3<L>(t.remembers, t.x - t.anchor, zero3<L>());
      f(static_cast<const Touching<T>&>(t));
    }
    t.count = 0;
  };
  for_near_points<T>(frame, cloud, rule.rolling_radius, [&](int i) {
    t.index[t.count++] = i;
    if (t.count == width) flush();
  });
  if (t.count > 0) flush();
}

// The anchors of one cloud after an accepted step; `next` and `next_set` may be the arrays that are read.
template <class T>
void advance_anchors(const PairFrame<T>& frame, const PointCloud& cloud, const TouchRule<T>& rule,
                     std::vector<std::pair<int, V3<T>>>& kept, V3<T>* next, std::uint8_t* next_set) {
  kept.clear();
  for_touching_points<T>(frame, cloud, rule, [&](const Touching<T>& t) {
    PointForce<Pack<T>> force;
    point_force<0>(t.law, t.at, t.v, t.e, t.remembers, force);
    const Vec3<Pack<T>> anchor = next_anchor(t.law, force, t.x, t.anchor, t.remembers);
    t.for_each_inside([&](int k, int i) { kept.emplace_back(i, lane3<T>(anchor, k)); });
  });
  std::fill(next_set, next_set + cloud.size(), 0);
  for (const auto& [i, anchor] : kept) {
    next[i] = anchor;
    next_set[i] = 1;
  }
}

// The dofs of a pair in the shape's frame, signs applied: δξ = Σ S_j δq_j, δV = Σ (Y_j δq_j + S_j δv_j).
template <class T>
struct PairColumns {
  static constexpr int most = 64;
  int n = 0;
  V6<T> s[most], y[most];
};

template <bool derivatives, class T>
void pair_columns(const PairDofs& pair, int first, const PairFrame<T>& f, const Workspace<T>& w, PairColumns<T>& c) {
  c.n = static_cast<int>(pair.dof.size());
  for (int i = 0; i < c.n; ++i) c.s[i] = (pair.first[i] ? T(1) : T(-1)) * f.motion(w.axis[pair.dof[i]]);
  if constexpr (derivatives) {
    const V6<T> twist = f.motion(first == world ? V6<T>(V6<T>::Zero()) : w.twist[first]);
    for (int i = 0; i < c.n; ++i) {
      c.y[i] = cross_motion<T>(c.s[i], V6<T>(twist - f.motion(w.twist_before[pair.dof[i]])));
    }
  }
}

// Gradients with respect to the relative pose and twist, carried to the joints.
template <class T>
void pull_back(const PairDofs& pair, const PairColumns<T>& c, const V6<T>& by_pose, const V6<T>& by_twist, VX<T>& by_q,
               VX<T>& by_v) {
  for (int i = 0; i < c.n; ++i) {
    by_q[pair.dof[i]] += c.s[i].dot(by_pose) + c.y[i].dot(by_twist);
    by_v[pair.dof[i]] += c.s[i].dot(by_twist);
  }
}

// The reverse of `advance_anchors`: gradients of the anchors after the step go to the relative pose and twist and to the
// anchors before.
template <class T>
void anchors_transposed(const PairFrame<T>& frame, const PointCloud& cloud, const TouchRule<T>& rule,
                        const V3<T>* by_next, V6<T>& by_pose, V6<T>& by_twist, V3<T>* by_anchor) {
  using L = Pack<T>;
  Vec3<L> turn = zero3<L>(), shift = turn, spin = turn, slide = turn;
  for_touching_points<T>(frame, cloud, rule, [&](const Touching<T>& t) {
    PointForce<L> force;
    point_force<2>(t.law, t.at, t.v, t.e, t.remembers, force);
    Vec3<L> lambda = zero3<L>();
    t.for_each_inside([&](int k, int i) { set_lane3<T>(lambda, k, by_next[i]); });
    const AnchorGradient<L> g = next_anchor_transposed(t.law, force, t.remembers, lambda);
    const Vec3<L> by_point = g.x - cross(spread<L>(frame.angular), g.v);
    turn += cross(t.center, by_point);
    shift += by_point;
    spin += cross(t.x, g.v);
    slide += g.v;
    t.for_each_inside([&](int k, int i) {
      if (is_set(t.remembers, k)) by_anchor[i] += lane3<T>(g.anchor, k);
    });
  });
  by_pose += stack<T>(sum3<T>(turn), sum3<T>(shift));
  by_twist += stack<T>(sum3<T>(spin), sum3<T>(slide));
}

}  // namespace gelflow
