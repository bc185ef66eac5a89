"""The robot on a page: its arm, gripper, part and hole."""
