"""Drivers of the robot cell (gripper, arm, cameras) and the insertion runner.

To add a device, write a class that fits `Gripper`, `Arm` or `Camera` of `gelflow.protocols`; `real/wsg/driver.py`,
`real/egm/driver.py` and `real/camera/driver.py` are the examples.
`real/runner/cell.py` creates the drivers of a run; see "Adding another gripper" in docs/guide/gripper.md.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
