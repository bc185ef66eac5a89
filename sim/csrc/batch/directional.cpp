#include "batch/directional.hpp"

#include <algorithm>
#include <span>

#include "solver/step.hpp"

namespace gelflow {

namespace {

// Updates after convergence: the derivative part converges one iteration after the value.
constexpr int polish = 3;

using Directions = std::span<const RolloutInput>;  // at most `Dual::directions`

// `count` numbers of one field of the input.
std::vector<Dual> dual_vector(const RolloutInput& start, Directions directions, const double* RolloutInput::* field,
                              std::size_t count) {
  std::vector<Dual> result(start.*field, start.*field + count);
  for (std::size_t k = 0; k < directions.size(); ++k) {
    for (std::size_t i = 0; i < count; ++i) result[i].b[k] = (directions[k].*field)[i];
  }
  return result;
}

// A tangent δ of a quaternion Q is the derivative Q ⊗ (0, δ/2).
std::vector<Dual> dual_positions(const Model& m, const double* q, Directions directions) {
  std::vector<Dual> result(q, q + m.nq);
  for (std::size_t k = 0; k < directions.size(); ++k) {
    for (const Joint& joint : m.joints) {
      const double* d = directions[k].q + joint.v;
      const int scalars = joint.scalar_dofs();
      for (int a = 0; a < scalars; ++a) result[joint.q + a].b[k] = d[a];
      if (!joint.has_quaternion()) continue;
      const V4<double> quat = vec4(q + joint.quaternion_q());
      const V4<double> rate =
          quaternion_product<double>(quat, {0, d[scalars] / 2, d[scalars + 1] / 2, d[scalars + 2] / 2});
      for (int a = 0; a < 4; ++a) result[joint.quaternion_q() + a].b[k] = rate[a];
    }
  }
  return result;
}

std::vector<double> position_tangent(const Model& m, const std::vector<Dual>& q, int k) {
  std::vector<double> tangent(m.nv);
  for (const Joint& joint : m.joints) {
    for (int a = 0; a < joint.scalar_dofs(); ++a) tangent[joint.v + a] = q[joint.q + a].b[k];
    if (!joint.has_quaternion()) continue;
    const Dual* t = &q[joint.quaternion_q()];
    const V4<double> conjugate(t[0].a, -t[1].a, -t[2].a, -t[3].a), rate(t[0].b[k], t[1].b[k], t[2].b[k], t[3].b[k]);
    const V4<double> product = quaternion_product<double>(conjugate, rate);
    for (int a = 0; a < 3; ++a) tangent[joint.angular_v() + a] = 2 * product[1 + a];
  }
  return tangent;
}

std::vector<double> values(const std::vector<Dual>& x) {
  std::vector<double> result;
  for (const Dual& one : x) result.push_back(one.a);
  return result;
}

std::vector<double> derivatives(const std::vector<Dual>& x, int k) {
  std::vector<double> result;
  for (const Dual& one : x) result.push_back(one.b[k]);
  return result;
}

// Appends the derivatives along at most `Dual::directions` directions to `out`.
void run(const Model& m, int steps, const RolloutInput& start, Directions directions, DirectionalRollout& out) {
  const std::size_t nu = m.actuators.size();
  const auto dual = [&](const double* RolloutInput::* field, std::size_t count) {
    return dual_vector(start, directions, field, count);
  };
  const std::vector<Dual> params = dual(&RolloutInput::params, m.param_names.size());
  const std::vector<Dual> controls = dual(&RolloutInput::u, steps * nu);
  std::vector<Dual> q = dual_positions(m, start.q, directions), v = dual(&RolloutInput::v, m.nv);
  std::vector<Dual> history = dual(&RolloutInput::history, m.nh);
  std::vector<Dual> flat = dual(&RolloutInput::anchors, static_cast<std::size_t>(m.na) * 3);
  std::vector<V3<Dual>> anchors(m.na);
  std::vector<std::uint8_t> anchored(start.anchored, start.anchored + m.na);
  for (int i = 0; i < m.na; ++i) {
    for (int a = 0; a < 3; ++a) anchors[i][a] = flat[3 * i + a];
  }
  const StateView<Dual> state{q.data(), v.data(), anchors.data(), anchored.data(), history.data()};
  follow_leaders<Dual>(m, state);
  StepMemory<Dual> memory(m);
  for (int t = 0; t < steps; ++t) {
    const StepReport report = step<Dual>(m, params.data(), controls.data() + t * nu, polish, state, memory, false);
    out.status = static_cast<std::int32_t>(report.status);
    if (report.status != Status::ok) break;
  }
  std::vector<Dual> tactile(static_cast<std::size_t>(m.num_markers) * 3);
  forward_state<false, Dual>(m, params.data(), q.data(), nullptr, v.data(), memory.work);
  read_markers<Dual>(m, params.data(), anchors.data(), anchored.data(), memory.work, tactile.data(), nullptr);

  for (int i = 0; i < m.na; ++i) {
    for (int a = 0; a < 3; ++a) flat[3 * i + a] = anchors[i][a];
  }
  out.end = {values(q), values(v), values(flat), values(tactile)};
  for (int k = 0; k < static_cast<int>(directions.size()); ++k) {
    out.derivatives.push_back(
        {position_tangent(m, q, k), derivatives(v, k), derivatives(flat, k), derivatives(tactile, k)});
  }
  out.anchored = anchored;
}

}  // namespace

DirectionalRollout directional_rollout(const Model& m, int steps, const RolloutInput& start,
                                       const std::vector<RolloutInput>& directions) {
  DirectionalRollout out;
  const Directions all(directions);
  constexpr std::size_t together = Dual::directions;
  for (std::size_t first = 0; first < all.size(); first += together) {
    run(m, steps, start, all.subspan(first, std::min(together, all.size() - first)), out);
    if (out.status != static_cast<std::int32_t>(Status::ok)) break;
  }
  return out;
}

}  // namespace gelflow
