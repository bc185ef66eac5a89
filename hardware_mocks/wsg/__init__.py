"""Mock of the Weiss WSG-50 gripper on a pty and on TCP."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
