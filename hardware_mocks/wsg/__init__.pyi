from .device import MockWsgGripper as MockWsgGripper
from .finger_controller import MockWsgConfig as MockWsgConfig

__all__ = [
    "MockWsgConfig",
    "MockWsgGripper",
]
