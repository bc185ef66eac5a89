"""Parts that the tasks of the parallel gripper share: attempts, pads, and the bar of the grasp task."""
