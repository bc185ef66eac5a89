#include "batch/batch.hpp"

namespace gelflow {

DirectionalRollout directional_rollout(const Model& m, const RolloutStart& start) {
  const std::size_t np = m.param_names.size(), nu = m.actuators.size();
  std::vector<Dual> params(np), q(m.nq), v(m.nv), u(nu);
  std::vector<V3<Dual>> anchors(m.na);
  std::vector<std::uint8_t> anchored(start.anchored, start.anchored + m.na);
  for (std::size_t i = 0; i < np; ++i) params[i] = {start.params[i], start.dparams[i]};
  for (int i = 0; i < m.nv; ++i) v[i] = {start.v[i], start.dv[i]};
  for (int i = 0; i < m.na; ++i) {
    for (int a = 0; a < 3; ++a) anchors[i][a] = {start.anchors[3 * i + a], start.danchors[3 * i + a]};
  }
  // A tangent δ of a quaternion Q is the derivative Q ⊗ (0, δ/2).
  for (const Joint& joint : m.joints) {
    const double* value = start.q + joint.q;
    const double* d = start.dq + joint.v;
    const int plain = joint.scalar_dofs();
    for (int a = 0; a < plain; ++a) q[joint.q + a] = {value[a], d[a]};
    if (!joint.has_quaternion()) continue;
    const V4<double> turn = vec4(value + plain);
    const V4<double> rate = quaternion_product<double>(turn, {0, d[plain] / 2, d[plain + 1] / 2, d[plain + 2] / 2});
    for (int a = 0; a < 4; ++a) q[joint.quaternion_q() + a] = {turn[a], rate[a]};
  }
  std::vector<Dual> history(m.nh);
  for (int i = 0; i < m.nh; ++i) history[i] = {start.history[i], start.dhistory[i]};
  const StateView<Dual> state{q.data(), v.data(), anchors.data(), anchored.data(), history.data()};
  StepMemory<Dual> memory(m);
  DirectionalRollout out;
  for (int t = 0; t < start.steps; ++t) {
    for (std::size_t a = 0; a < nu; ++a) u[a] = {start.u[t * nu + a], start.du[t * nu + a]};
    // Updates after convergence: the derivative part converges one iteration behind the value.
    const StepReport report = step<Dual>(m, params.data(), u.data(), 3, state, memory, false);
    out.status = static_cast<std::int32_t>(report.status);
    if (report.status != Status::ok) break;
  }
  std::vector<Dual> tactile(static_cast<std::size_t>(m.markers) * 3);
  forward_state<false, Dual>(m, params.data(), q.data(), nullptr, v.data(), memory.work);
  read_markers<Dual>(m, params.data(), anchors.data(), anchored.data(), memory.work, tactile.data(), nullptr);

  for (const Dual& x : q) out.q.push_back(x.a);
  out.dq.resize(m.nv);
  for (const Joint& joint : m.joints) {
    for (int a = 0; a < joint.scalar_dofs(); ++a) out.dq[joint.v + a] = q[joint.q + a].b;
    if (!joint.has_quaternion()) continue;
    const Dual* t = &q[joint.quaternion_q()];
    const V4<double> conjugate(t[0].a, -t[1].a, -t[2].a, -t[3].a), rate(t[0].b, t[1].b, t[2].b, t[3].b);
    const V4<double> turning = quaternion_product<double>(conjugate, rate);
    for (int a = 0; a < 3; ++a) out.dq[joint.angular_v() + a] = 2 * turning[1 + a];
  }
  const auto split = [](const Dual& x, std::vector<double>& value, std::vector<double>& derivative) {
    value.push_back(x.a);
    derivative.push_back(x.b);
  };
  for (const Dual& x : v) split(x, out.v, out.dv);
  for (const Dual& x : tactile) split(x, out.tactile, out.dtactile);
  for (const auto& anchor : anchors) {
    for (int a = 0; a < 3; ++a) split(anchor[a], out.anchors, out.danchors);
  }
  out.anchored = anchored;
  return out;
}

}  // namespace gelflow
