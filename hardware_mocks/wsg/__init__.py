"""The mock WSG-50 gripper."""
