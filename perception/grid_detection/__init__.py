"""Finds the dots and the grid of markers in a first image."""
