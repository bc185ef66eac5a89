from .camera.device import MockMjpegCamera as MockMjpegCamera
from .egm.controller import MockEgmConfig as MockEgmConfig
from .egm.controller import MockEgmReport as MockEgmReport
from .egm.device import MockEgmArm as MockEgmArm
from .faults.plan import Fault as Fault
from .faults.plan import FaultPlan as FaultPlan
from .faults.plan_file import load_fault_plan as load_fault_plan
from .faults.random_plan import random_plan as random_plan
from .plant import ArmPlant as ArmPlant
from .plant import GelPlant as GelPlant
from .plant import GripperPlant as GripperPlant
from .plant import KinematicArm as KinematicArm
from .plant import KinematicGripper as KinematicGripper
from .robot import MockRobot as MockRobot
from .robot import MockRobotConfig as MockRobotConfig
from .simulated_cell.cell import SimulatedCell as SimulatedCell
from .simulated_cell.cell import SimulatedCellConfig as SimulatedCellConfig
from .simulated_cell.cell import preset_config as preset_config
from .simulated_cell.process import SimulatedCellProcess as SimulatedCellProcess
from .simulated_cell.world import World as World
from .simulated_cell.world import load_world as load_world
from .wsg.device import MockWsgGripper as MockWsgGripper
from .wsg.finger_controller import MockWsgConfig as MockWsgConfig

__all__ = [
    "ArmPlant",
    "Fault",
    "FaultPlan",
    "GelPlant",
    "GripperPlant",
    "KinematicArm",
    "KinematicGripper",
    "MockEgmArm",
    "MockEgmConfig",
    "MockEgmReport",
    "MockMjpegCamera",
    "MockRobot",
    "MockRobotConfig",
    "MockWsgConfig",
    "MockWsgGripper",
    "SimulatedCell",
    "SimulatedCellConfig",
    "SimulatedCellProcess",
    "World",
    "load_fault_plan",
    "load_world",
    "preset_config",
    "random_plan",
]
