"""Accuracy against computing time of a scene's settings (`gelflow tradeoff`)."""
