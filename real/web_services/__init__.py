"""State of an ABB controller over Robot Web Services 1.0: mode, motors and program, for supervision only."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
