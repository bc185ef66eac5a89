"""Architectures of policy networks, one per file: settings, inference in NumPy, and training in torch."""
