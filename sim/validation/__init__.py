"""Checks of the simulator: gradients, energy, stress, reference motions."""
