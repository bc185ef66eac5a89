from .decision_picture import draw_comparisons as draw_comparisons
from .decision_replay import Comparison as Comparison
from .decision_replay import ImageTracker as ImageTracker
from .decision_replay import PerceptionPipeline as PerceptionPipeline
from .decision_replay import replay as replay
from .messages import Damage as Damage
from .reader import Record as Record
from .reader import SessionReader as SessionReader
from .recorder import SessionRecorder as SessionRecorder
from .records import SENSORS as SENSORS
from .records import Decision as Decision
from .records import describe_session as describe_session
from .recovery import RecoveryReport as RecoveryReport
from .recovery import recover as recover
from .time_index import TimeIndex as TimeIndex

__all__ = [
    "SENSORS",
    "Comparison",
    "Damage",
    "Decision",
    "ImageTracker",
    "PerceptionPipeline",
    "Record",
    "RecoveryReport",
    "SessionReader",
    "SessionRecorder",
    "TimeIndex",
    "describe_session",
    "draw_comparisons",
    "recover",
    "replay",
]
