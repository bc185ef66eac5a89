"""Calibration: fits the simulator to recorded insertions."""
