"""gelflow: a sim-to-real toolkit for tactile manipulation."""

import lazy_loader as _lazy

from gelflow.gymnasium_registration import register_when_imported as _register_when_imported

__version__ = "0.1.0"

# Packages are imported on first use, so that `import gelflow` stays fast.
__getattr__, __dir__, __all__ = _lazy.attach(
    __name__, submodules=["gel", "hardware_mocks", "perception", "policies", "real", "session", "sim", "view"]
)

_register_when_imported()
