from .cell import Cell as Cell
from .cell import open_cell as open_cell
from .insertion.attempt import Attempt as Attempt
from .insertion.attempt import Insertion as Insertion
from .insertion.insertion_runner import InsertionRunner as InsertionRunner
from .insertion.insertion_runner import Operator as Operator
from .insertion.planned_motions import PlanPolicy as PlanPolicy
from .lab import Lab as Lab
from .lab_file import load_lab as load_lab
from .lab_file import save_lab as save_lab
from .motion_executor import MotionExecutor as MotionExecutor
from .phases import PHASES as PHASES
from .phases import Phase as Phase
from .preflight import PreflightItem as PreflightItem
from .preflight import run_preflight as run_preflight
from .run_plan import RunPlan as RunPlan
from .run_plan import dry_run as dry_run
from .run_plan import run_insertions as run_insertions
from .supervisor import Supervisor as Supervisor
from .touch.observer import TactileObserver as TactileObserver
from .touch.observer import TactileReading as TactileReading

__all__ = [
    "PHASES",
    "Attempt",
    "Cell",
    "Insertion",
    "InsertionRunner",
    "Lab",
    "MotionExecutor",
    "Operator",
    "Phase",
    "PlanPolicy",
    "PreflightItem",
    "RunPlan",
    "Supervisor",
    "TactileObserver",
    "TactileReading",
    "dry_run",
    "load_lab",
    "open_cell",
    "run_insertions",
    "run_preflight",
    "save_lab",
]
