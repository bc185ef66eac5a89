// The parts of the Python module gelflow.sim._core, in the order in which bindings.cpp adds them.
#pragma once

#include <pybind11/pybind11.h>

namespace gelflow {

void bind_definitions(pybind11::module_& module);
void bind_model(pybind11::module_& module);
void bind_batches(pybind11::module_& module);
void bind_directional(pybind11::module_& module);
void bind_sites(pybind11::module_& module);

}  // namespace gelflow
