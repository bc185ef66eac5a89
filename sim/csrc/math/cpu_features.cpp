// What this processor can do, asked before the core is chosen (sim/_core.py): compiled for any processor.
#include <pybind11/pybind11.h>

namespace {

// Whether code compiled for x86-64-v3 runs here: processor and operating system both know AVX2 and its companions.
bool runs_v3() {
#if defined(__x86_64__) && (defined(__GNUC__) || defined(__clang__))
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
         __builtin_cpu_supports("bmi2");
#else
  return false;
#endif
}

}  // namespace

PYBIND11_MODULE(_core_cpu_features, module) { module.def("runs_v3", &runs_v3); }
