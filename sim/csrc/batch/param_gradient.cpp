// clang-format off: the templates of the core need the overloads of tape.hpp
#include "math/tape.hpp"
// clang-format on
#include "batch/param_gradient.hpp"
#include "solver/step.hpp"

namespace gelflow {

namespace {

// One state as taped numbers; the parameters are the inputs of the tape.
struct TapedState {
  std::vector<Taped> params, q0, v0, history, v1, u;
  std::vector<V3<Taped>> anchors;

  TapedState(const Model& m, const double* numbers, const ParamState& s) {
    Tape::current().clear();
    for (std::size_t i = 0; i < m.param_names.size(); ++i) params.push_back(Taped::variable(numbers[i]));
    q0.assign(s.q0, s.q0 + m.nq);
    v0.assign(s.v0, s.v0 + m.nv);
    if (s.history != nullptr) history.assign(s.history, s.history + 2 * m.nv);
    if (s.v1 != nullptr) v1.assign(s.v1, s.v1 + m.nv);
    if (s.u != nullptr) u.assign(s.u, s.u + m.actuators.size());
    for (int i = 0; i < m.na; ++i) anchors.push_back(s.anchors[i].cast<Taped>());
  }

  // Adds the gradient with respect to the parameters, which are the first entries on the tape. `weights` are the
  // gradients of all its entries.
  void add_to(double* grad_params, std::vector<double>& weights) const {
    Tape::current().backward(weights);
    for (std::size_t i = 0; i < params.size(); ++i) grad_params[i] += weights[i];
  }
};

void set_weight(std::vector<double>& weights, const Taped& result, double weight) {
  if (result.entry >= 0) weights[result.entry] += weight;
}

}  // namespace

void add_step_param_gradient(const Model& m, const double* params, const ParamState& s, const double* multipliers,
                             const V3<double>* grad_next, double* grad_params) {
  TapedState t(m, params, s);
  Workspace<Taped> w(m);
  const Taped beta_h(s.beta_h);
  const StepStart<Taped> start{
      beta_h,           t.q0.data(), t.v0.data(), nullptr, t.history.empty() ? nullptr : t.history.data(),
      t.anchors.data(), s.anchored,  t.u.data()};
  evaluate<false, Taped>(m, t.params.data(), start, t.v1.data(), CacheState::stale, false, w);
  std::vector<V3<Taped>> next = t.anchors;
  std::vector<std::uint8_t> next_set(s.anchored, s.anchored + m.na);
  if (m.na > 0) {
    advance_contact_anchors<Taped>(m, t.params.data(), start.length(), t.anchors.data(), s.anchored, w, next.data(),
                                   next_set.data());
    advance_marker_anchors<Taped>(m, t.params.data(), start.length(), t.anchors.data(), s.anchored, w, next.data(),
                                  next_set.data());
  }
  std::vector<double> weights(Tape::current().size(), 0.0);
  for (int k = 0; k < m.nv; ++k) set_weight(weights, w.residual[k], -multipliers[k]);
  for (int i = 0; i < m.na; ++i) {
    for (int a = 0; next_set[i] && a < 3; ++a) set_weight(weights, next[i][a], grad_next[i][a]);
  }
  t.add_to(grad_params, weights);
}

void add_reading_param_gradient(const Model& m, const double* params, const ParamState& s, const double* grad_reading,
                                double* grad_params) {
  TapedState t(m, params, s);
  Workspace<Taped> w(m);
  forward_state<false, Taped>(m, t.params.data(), t.q0.data(), nullptr, t.v0.data(), w);
  std::vector<Taped> readings(static_cast<std::size_t>(m.num_markers) * 3);
  read_markers<Taped>(m, t.params.data(), t.anchors.data(), s.anchored, w, readings.data(), nullptr);
  std::vector<double> weights(Tape::current().size(), 0.0);
  for (std::size_t i = 0; i < readings.size(); ++i) set_weight(weights, readings[i], grad_reading[i]);
  t.add_to(grad_params, weights);
}

}  // namespace gelflow
