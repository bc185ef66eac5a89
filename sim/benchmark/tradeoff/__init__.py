"""Accuracy against computing time: `gelflow tradeoff`."""
