"""The insertion runner: lab file, supervisor, motion, tactile observation and the insertion itself."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
