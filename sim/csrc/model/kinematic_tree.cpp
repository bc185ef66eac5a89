// The parts of a model that follow from all its elements together: the dofs that move each body, which dofs move the
// axes of others, the dofs that change the relative motion of each pair of bodies, and the leaders of couplings.
#include <algorithm>
#include <map>

#include "math/linear_solver.hpp"
#include "model/definition_checks.hpp"
#include "model/model_spec.hpp"

namespace gelflow {

namespace {

void find_body_dofs(Model& m) {
  for (Body& body : m.bodies) {  // parents come first, so their dofs are complete
    if (body.joint_begin == body.joint_end) reject("body '" + body.name + "' has no joint: merge it into its parent");
    if (body.parent != world) body.dofs = m.bodies[body.parent].dofs;
    for (int j = body.joint_begin; j < body.joint_end; ++j) {
      for (int i = 0; i < m.joints[j].dofs; ++i) body.dofs.push_back(m.joints[j].v + i);
    }
  }
}

void find_translations(Model& m) {
  m.translation_only.assign(m.nv, 0);
  for (Body& body : m.bodies) {
    body.translation_only = true;
    for (const int k : body.dofs) {  // root first
      body.translation_only = body.translation_only && !m.angular[k];
      m.translation_only[k] = body.translation_only;
    }
  }
}

void find_free_bodies(Model& m) {
  for (Body& body : m.bodies) {
    body.is_free = body.joint_end == body.joint_begin + 1 && m.joints[body.joint_begin].type == JointType::free;
  }
  for (const Body& body : m.bodies) {
    if (body.parent != world) m.bodies[body.parent].is_free = false;
  }
  for (int k = 0; k < m.nv; ++k) {
    if (!m.bodies[m.dof_body[k]].is_free) m.articulated_dofs.push_back(k);
  }
}

// The root's first dof comes first among those of a tree. Dofs of other trees may lie between it and the last one.
void find_trees(Model& m) {
  std::vector<int> last(m.nv, -1);  // of the tree, at its first dof
  for (int k = 0; k < m.nv; ++k) last[m.bodies[m.dof_body[k]].dofs.front()] = k;
  for (int k = 0; k < m.nv; ++k) {
    if (m.trees.empty() || k >= m.trees.back().end) m.trees.push_back({k, k + 1});
    m.trees.back().end = std::max(m.trees.back().end, last[k] + 1);
    m.dof_tree.push_back(static_cast<int>(m.trees.size()) - 1);
  }
  // Smaller systems are solved at once.
  m.has_islands = m.trees.size() > 1 && m.nv > max_inverse_size;
}

void couple_trees(Model& m, int first_dof, int second_dof) {
  if (first_dof < 0 || second_dof < 0 || m.dof_tree[first_dof] == m.dof_tree[second_dof]) return;
  m.coupled_trees.emplace_back(m.dof_tree[first_dof], m.dof_tree[second_dof]);
}

int first_dof(const Model& m, int body) { return body == world ? -1 : m.bodies[body].dofs.front(); }

void find_coupled_trees(Model& m) {
  for (const Coupling& c : m.couplings) couple_trees(m, c.dof, c.leader_dof);
  for (const PolynomialCoupling& c : m.polynomial_couplings) couple_trees(m, c.dof, c.leader_dof);
  for (const LoopClosure& c : m.loop_closures) couple_trees(m, first_dof(m, c.first), first_dof(m, c.second));
  for (const Tendon& tendon : m.tendons) {
    for (const Tendon::Term& term : tendon.terms) couple_trees(m, tendon.terms.front().dof, term.dof);
  }
}

using Signs = std::map<int, double>;  // of the dofs that move one body of a pair and not the other

// Packs of `width` neighbouring dofs that hold all dofs of the pair. With islands a pack holds dofs of one tree only,
// because only these are neighbours in the matrices.
PackedDofs pack_dofs(const Model& m, const Signs& signs, int width) {
  PackedDofs packed;
  for (const auto& [k, sign] : signs) {
    const bool in_pack = !packed.start.empty() && k < packed.start.back() + width;
    if (!in_pack || (m.has_islands && m.dof_tree[k] != m.dof_tree[packed.start.back()])) packed.start.push_back(k);
  }
  for (const int start : packed.start) {
    for (int k = start; k < start + width; ++k) {
      const auto found = signs.find(k);
      const bool in_pack = found != signs.end() && (!m.has_islands || m.dof_tree[k] == m.dof_tree[start]);
      packed.sign.push_back(in_pack ? found->second : 0.0);
      packed.dof.push_back(in_pack ? k : -1);
    }
  }
  for (const int row : packed.dof) {
    packed.linear.push_back(row >= 0 && m.angular[row] == 0);
    packed.has_coupling.push_back(0);
    for (const int column : packed.dof) {
      const bool both = row >= 0 && column >= 0;
      const bool counts = both && (signs.at(column) > 0 ? signs.at(row) > 0 && m.is_ancestor(column, row)
                                                        : signs.at(row) > 0 || !m.is_ancestor(column, row));
      packed.axis_coupling.push_back(counts ? 1.0 : 0.0);
      if (counts) packed.has_coupling.back() = 1;
    }
  }
  return packed;
}

PairDofs pair_dofs(Model& m, int first, int second) {
  Signs signs;  // a dof that moves both bodies cancels
  if (first != world) {
    for (const int k : m.bodies[first].dofs) signs[k] += 1;
  }
  if (second != world) {
    for (const int k : m.bodies[second].dofs) signs[k] -= 1;
  }
  std::erase_if(signs, [](const auto& item) { return item.second == 0; });
  const PairDofs pair{pack_dofs(m, signs, 1), pack_dofs(m, signs, 4), pack_dofs(m, signs, 8)};
  for (const PackedDofs* packed : {&pair.single, &pair.four, &pair.eight}) {
    m.jacobian_columns = std::max(m.jacobian_columns, static_cast<int>(packed->dof.size()));
  }
  return pair;
}

}  // namespace

void build_kinematic_tree(Model& model) {
  find_body_dofs(model);
  find_translations(model);
  find_free_bodies(model);
  find_trees(model);
  find_coupled_trees(model);
}

void build_contact_pairs(Model& model) {
  for (LoopClosure& closure : model.loop_closures) closure.pair = pair_dofs(model, closure.first, closure.second);
  for (Contact& contact : model.contacts) {
    const PointSet& set = model.point_sets[contact.points];
    const Shape& shape = model.shapes[contact.shape];
    contact.pair = pair_dofs(model, set.mount.body, shape.body);
    const int first = first_dof(model, set.mount.body), second = first_dof(model, shape.body);
    if (model.has_islands && first >= 0 && second >= 0 && model.dof_tree[first] != model.dof_tree[second]) {
      contact.first_tree = model.dof_tree[first];
      contact.second_tree = model.dof_tree[second];
    }
    contact.uses_arc_correction = set.mount.body != world && model.bodies[set.mount.body].is_free &&
                                  shape.body == world && shape.kind == ShapeKind::plane &&
                                  (set.radius == 0 || set.cloud.extent > 0);
  }
  for (Pad& pad : model.pads) {
    for (const int s : pad.shapes) pad.pairs.push_back(pair_dofs(model, pad.mount.body, model.shapes[s].body));
  }
}

// A leader that follows another joint is replaced by that joint's leader.
void build_couplings(Model& model) {
  std::vector<const Coupling*> of_dof(model.nv, nullptr);
  for (const Coupling& coupling : model.couplings) {
    const Joint& joint = model.joints[model.dof_joint[coupling.dof]];
    if (of_dof[coupling.dof] != nullptr) reject("joint '" + joint.name + "' follows two joints");
    of_dof[coupling.dof] = &coupling;
  }
  std::vector<Coupling> resolved = model.couplings;
  for (Coupling& coupling : resolved) {
    std::size_t hops = 0;
    while (coupling.leader_dof >= 0 && of_dof[coupling.leader_dof] != nullptr) {
      if (++hops > model.couplings.size()) reject("coupling '" + coupling.name + "': the joint follows itself");
      const Coupling& next = *of_dof[coupling.leader_dof];
      coupling.offset += coupling.ratio * next.offset;
      coupling.ratio *= next.ratio;
      coupling.leader_q = next.leader_q;
      coupling.leader_dof = next.leader_dof;
    }
    const double leader = coupling.leader_q < 0 ? 0 : model.q0[coupling.leader_q];
    model.q0[coupling.q] = coupling.offset + coupling.ratio * leader;
  }
  model.couplings = resolved;
}

}  // namespace gelflow
