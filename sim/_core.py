"""The C++ core, in the build that runs fastest on this processor.

GELFLOW_CORE=base takes the build for any processor, for comparing; GELFLOW_CORE=v3 the one for AVX2;
GELFLOW_CORE=sanitize the one that `make sanitize` builds and runs, which stops at the first bad access.
"""

import importlib
import os

from gelflow.sim._core_cpu_features import runs_v3

from gelflow.errors import UsageError

_wanted = os.environ.get("GELFLOW_CORE") or ("v3" if runs_v3() else "base")
if _wanted not in ("base", "v3", "sanitize"):
    raise UsageError(f"GELFLOW_CORE must be base or v3 (or sanitize, as make sanitize sets it), got {_wanted!r}")
if _wanted == "v3" and not runs_v3():
    raise UsageError("GELFLOW_CORE=v3 needs a processor with AVX2; leave it out")
_built = importlib.import_module(f"gelflow.sim._core_{_wanted}")
globals().update({name: value for name, value in vars(_built).items() if not name.startswith("__")})
LEVEL = _wanted
