"""Touch during a run: observation of both pads, guarded motion, and the check of the pads at every grasp."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
