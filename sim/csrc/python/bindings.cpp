// The Python module gelflow.sim._core. The bindings convert arguments and check shapes; they contain no other logic.
#include "python/bindings.hpp"

PYBIND11_MODULE(GELFLOW_CORE, module) {
  module.doc() = "C++ core of the simulator; use gelflow.sim.Simulator.";
  gelflow::bind_definitions(module);
  gelflow::bind_model(module);
  gelflow::bind_batches(module);
  gelflow::bind_directional(module);
  gelflow::bind_sites(module);
}
