"""Calibrations in random worlds with known truth."""
