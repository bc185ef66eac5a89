from .cell import SimulatedCell as SimulatedCell
from .cell import SimulatedCellConfig as SimulatedCellConfig
from .cell import preset_config as preset_config
from .part_truth import PartTruth as PartTruth
from .process import SimulatedCellProcess as SimulatedCellProcess
from .world import World as World
from .world import load_world as load_world

__all__ = [
    "PartTruth",
    "SimulatedCell",
    "SimulatedCellConfig",
    "SimulatedCellProcess",
    "World",
    "load_world",
    "preset_config",
]
