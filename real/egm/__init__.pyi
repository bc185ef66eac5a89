from .config import EgmConfig as EgmConfig
from .cycle_log import EgmCycle as EgmCycle
from .cycle_log import MessageCounts as MessageCounts
from .driver import EgmArm as EgmArm
from .reference_generator import EgmEvent as EgmEvent
from .reference_generator import EgmFlag as EgmFlag
from .timing import EgmTiming as EgmTiming

__all__ = [
    "EgmArm",
    "EgmConfig",
    "EgmCycle",
    "EgmEvent",
    "EgmFlag",
    "EgmTiming",
    "MessageCounts",
]
