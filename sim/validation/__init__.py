"""Verification of the simulator: gradients, energy, stress tests, reference motions, and studies of its accuracy."""
