from .config import WsgConfig as WsgConfig
from .config import WsgLimits as WsgLimits
from .driver import WsgGripper as WsgGripper
from .link import WsgRefused as WsgRefused

__all__ = [
    "WsgConfig",
    "WsgGripper",
    "WsgLimits",
    "WsgRefused",
]
