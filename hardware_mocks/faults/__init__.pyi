from .plan import Fault as Fault
from .plan import FaultPlan as FaultPlan
from .plan_file import load_plan as load_plan
from .random_plan import random_plan as random_plan

__all__ = [
    "Fault",
    "FaultPlan",
    "load_plan",
    "random_plan",
]
