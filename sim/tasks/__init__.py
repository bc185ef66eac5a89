"""Tasks built on the simulator."""
