"""Scenes: loading from MJCF, URDF and TOML files, and the definitions of their elements."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
