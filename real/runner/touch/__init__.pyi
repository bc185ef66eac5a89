from .grasp_check import GraspCheck as GraspCheck
from .grasp_check import TouchThresholds as TouchThresholds
from .guarded_motion import GuardedMotion as GuardedMotion
from .observer import MarkersUnreadable as MarkersUnreadable
from .observer import TactileObserver as TactileObserver
from .observer import TactileReading as TactileReading

__all__ = [
    "GraspCheck",
    "GuardedMotion",
    "MarkersUnreadable",
    "TactileObserver",
    "TactileReading",
    "TouchThresholds",
]
