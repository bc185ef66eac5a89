"""Driver of the Weiss WSG-50 gripper."""
