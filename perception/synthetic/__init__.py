"""Synthetic gel images with ground-truth marker positions.

`FastGelRenderer` draws an undamaged gel for streaming mock cameras. `AccurateGelRenderer` draws gels with imperfect
print, light and lens for tests and benchmarks; `GelSequence` renders a moving contact with it.
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
