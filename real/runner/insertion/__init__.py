"""The insertion of a part: the sequence of its attempts, the motions of the held part, results and their picture."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
