from .cell import PartTruth as PartTruth
from .cell import SimulatedCell as SimulatedCell
from .cell import SimulatedCellConfig as SimulatedCellConfig
from .cell import preset_config as preset_config
from .process import SimulatedCellProcess as SimulatedCellProcess

__all__ = [
    "PartTruth",
    "SimulatedCell",
    "SimulatedCellConfig",
    "SimulatedCellProcess",
    "preset_config",
]
