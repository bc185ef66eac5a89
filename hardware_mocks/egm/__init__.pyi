from .controller import MockEgmConfig as MockEgmConfig
from .controller import MockEgmReport as MockEgmReport
from .device import MockEgmArm as MockEgmArm

__all__ = [
    "MockEgmArm",
    "MockEgmConfig",
    "MockEgmReport",
]
