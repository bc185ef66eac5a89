"""Speed of the simulator: the measurements of `gelflow bench`."""
