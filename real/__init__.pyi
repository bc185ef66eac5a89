from .camera.driver import MjpegCamera as MjpegCamera
from .camera.driver import UvcCamera as UvcCamera
from .camera.driver import open_camera as open_camera
from .egm.config import EgmConfig as EgmConfig
from .egm.driver import EgmArm as EgmArm
from .runner.cell import Cell as Cell
from .runner.cell import open_cell as open_cell
from .runner.insertion.insertion_runner import InsertionRunner as InsertionRunner
from .runner.lab import Lab as Lab
from .runner.lab_file import load_lab as load_lab
from .runner.lab_file import save_lab as save_lab
from .runner.run_plan import RunPlan as RunPlan
from .runner.run_plan import dry_run as dry_run
from .runner.run_plan import run_insertions as run_insertions
from .runner.supervisor import Supervisor as Supervisor
from .transport import SerialTransport as SerialTransport
from .transport import TcpTransport as TcpTransport
from .transport import transport_for as transport_for
from .wsg.config import WsgConfig as WsgConfig
from .wsg.config import WsgLimits as WsgLimits
from .wsg.driver import WsgGripper as WsgGripper

__all__ = [
    "Cell",
    "EgmArm",
    "EgmConfig",
    "InsertionRunner",
    "Lab",
    "MjpegCamera",
    "RunPlan",
    "SerialTransport",
    "Supervisor",
    "TcpTransport",
    "UvcCamera",
    "WsgConfig",
    "WsgGripper",
    "WsgLimits",
    "dry_run",
    "load_lab",
    "open_camera",
    "open_cell",
    "run_insertions",
    "save_lab",
    "transport_for",
]
