"""Mock gripper, arm and cameras that answer on the wire, with the simulator as their physics."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
