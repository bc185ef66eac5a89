// Functions for several processors.
#pragma once

// Compiles a function twice, for the baseline and for AVX2; the loader selects one. The functions that it calls must be
// inlined. The sanitizer build has one version.
#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(GELFLOW_SANITIZE)
#define GELFLOW_CLONES __attribute__((target_clones("default", "arch=x86-64-v3")))
#else
#define GELFLOW_CLONES
#endif
#define GELFLOW_INLINE inline __attribute__((always_inline))
