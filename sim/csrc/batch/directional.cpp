#include "batch/directional.hpp"

#include "solver/step.hpp"

namespace gelflow {

namespace {

// Updates after convergence: the derivative part converges one iteration after the value.
constexpr int polish = 3;

Dual dual(double value, double derivative) { return {value, derivative}; }

// A tangent δ of a quaternion Q is the derivative Q ⊗ (0, δ/2).
std::vector<Dual> dual_positions(const Model& m, const double* q, const double* tangent) {
  std::vector<Dual> result(m.nq);
  for (const Joint& joint : m.joints) {
    const double* d = tangent + joint.v;
    const int scalars = joint.scalar_dofs();
    for (int a = 0; a < scalars; ++a) result[joint.q + a] = dual(q[joint.q + a], d[a]);
    if (!joint.has_quaternion()) continue;
    const V4<double> quat = vec4(q + joint.quaternion_q());
    const V4<double> rate =
        quaternion_product<double>(quat, {0, d[scalars] / 2, d[scalars + 1] / 2, d[scalars + 2] / 2});
    for (int a = 0; a < 4; ++a) result[joint.quaternion_q() + a] = dual(quat[a], rate[a]);
  }
  return result;
}

std::vector<double> position_tangent(const Model& m, const std::vector<Dual>& q) {
  std::vector<double> tangent(m.nv);
  for (const Joint& joint : m.joints) {
    for (int a = 0; a < joint.scalar_dofs(); ++a) tangent[joint.v + a] = q[joint.q + a].b;
    if (!joint.has_quaternion()) continue;
    const Dual* t = &q[joint.quaternion_q()];
    const V4<double> conjugate(t[0].a, -t[1].a, -t[2].a, -t[3].a), rate(t[0].b, t[1].b, t[2].b, t[3].b);
    const V4<double> product = quaternion_product<double>(conjugate, rate);
    for (int a = 0; a < 3; ++a) tangent[joint.angular_v() + a] = 2 * product[1 + a];
  }
  return tangent;
}

std::vector<Dual> dual_vector(const double* values, const double* derivatives, std::size_t count) {
  std::vector<Dual> result(count);
  for (std::size_t i = 0; i < count; ++i) result[i] = dual(values[i], derivatives[i]);
  return result;
}

void split(const Dual& x, std::vector<double>& value, std::vector<double>& derivative) {
  value.push_back(x.a);
  derivative.push_back(x.b);
}

}  // namespace

DirectionalRollout directional_rollout(const Model& m, int steps, const RolloutInput& start,
                                       const RolloutInput& direction) {
  const std::size_t nu = m.actuators.size();
  const std::vector<Dual> params = dual_vector(start.params, direction.params, m.param_names.size());
  const std::vector<Dual> controls = dual_vector(start.u, direction.u, steps * nu);
  std::vector<Dual> q = dual_positions(m, start.q, direction.q), v = dual_vector(start.v, direction.v, m.nv);
  std::vector<Dual> history = dual_vector(start.history, direction.history, m.nh);
  std::vector<V3<Dual>> anchors(m.na);
  std::vector<std::uint8_t> anchored(start.anchored, start.anchored + m.na);
  for (int i = 0; i < m.na; ++i) {
    for (int a = 0; a < 3; ++a) anchors[i][a] = dual(start.anchors[3 * i + a], direction.anchors[3 * i + a]);
  }
  const StateView<Dual> state{q.data(), v.data(), anchors.data(), anchored.data(), history.data()};
  follow_leaders<Dual>(m, state);
  StepMemory<Dual> memory(m);
  DirectionalRollout out;
  for (int t = 0; t < steps; ++t) {
    const StepReport report = step<Dual>(m, params.data(), controls.data() + t * nu, polish, state, memory, false);
    out.status = static_cast<std::int32_t>(report.status);
    if (report.status != Status::ok) break;
  }
  std::vector<Dual> tactile(static_cast<std::size_t>(m.num_markers) * 3);
  forward_state<false, Dual>(m, params.data(), q.data(), nullptr, v.data(), memory.work);
  read_markers<Dual>(m, params.data(), anchors.data(), anchored.data(), memory.work, tactile.data(), nullptr);

  for (const Dual& x : q) out.end.q.push_back(x.a);
  out.derivative.q = position_tangent(m, q);
  for (const Dual& x : v) split(x, out.end.v, out.derivative.v);
  for (const Dual& x : tactile) split(x, out.end.tactile, out.derivative.tactile);
  for (const auto& anchor : anchors) {
    for (int a = 0; a < 3; ++a) split(anchor[a], out.end.anchors, out.derivative.anchors);
  }
  out.anchored = anchored;
  return out;
}

}  // namespace gelflow
