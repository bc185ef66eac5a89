"""Rendered gel images with known marker positions."""
