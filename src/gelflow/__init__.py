"""gelflow: a sim-to-real toolkit for tactile manipulation."""

from gelflow.gymnasium_registration import register_when_imported as _register_when_imported

__version__ = "0.1.0"

_register_when_imported()
