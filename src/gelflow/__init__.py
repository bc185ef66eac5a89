"""gelflow: a sim-to-real toolkit for tactile manipulation."""

__version__ = "0.1.0"
