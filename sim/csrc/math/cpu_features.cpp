// CPU feature detection, by which sim/_core.py chooses the build of the core. Compiled for the baseline instruction set.
#include <pybind11/pybind11.h>

namespace {

// Whether the CPU and the operating system support x86-64-v3 (AVX2, FMA, BMI).
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
