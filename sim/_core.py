"""The C++ core in the fastest build that the processor supports.

The environment variable GELFLOW_CORE selects a build: "base" runs on any processor, "v3" needs AVX2, "sanitize" is the
build of `make sanitize` with AddressSanitizer and UBSan.
"""

import importlib
import os

from gelflow.sim._core_cpu_features import runs_v3

from gelflow.errors import UsageError

_level = os.environ.get("GELFLOW_CORE") or ("v3" if runs_v3() else "base")
if _level not in ("base", "v3", "sanitize"):
    raise UsageError(f"GELFLOW_CORE must be base or v3, or sanitize after `make sanitize`, got {_level!r}")
if _level == "v3" and not runs_v3():
    raise UsageError("GELFLOW_CORE=v3 needs a processor with AVX2; unset GELFLOW_CORE to choose a build automatically")
_build = importlib.import_module(f"gelflow.sim._core_{_level}")
globals().update({name: value for name, value in vars(_build).items() if not name.startswith("__")})
LEVEL = _level
