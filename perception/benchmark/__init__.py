"""Measurements of marker tracking, for `gelflow bench tracking`: errors on images with known truth, and speed."""
