"""Parts of one's own for the insertion: part files, their geometry, and the scene with a part and its hole."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
