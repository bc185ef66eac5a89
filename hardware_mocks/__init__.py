"""The device side of every wire: gripper, arm and cameras that answer as the real ones do."""
