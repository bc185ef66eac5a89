from .gripper_actions import acknowledge as acknowledge
from .gripper_actions import home as home
from .gripper_actions import open_fingers as open_fingers
from .jog import Jog as Jog
from .jog import jog as jog
from .question import Session as Session
from .status import read_status as read_status

__all__ = [
    "Jog",
    "Session",
    "acknowledge",
    "home",
    "jog",
    "open_fingers",
    "read_status",
]
