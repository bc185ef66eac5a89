from .plan import Fault as Fault
from .plan import FaultPlan as FaultPlan
from .plan_file import load_fault_plan as load_fault_plan
from .random_plan import random_plan as random_plan

__all__ = [
    "Fault",
    "FaultPlan",
    "load_fault_plan",
    "random_plan",
]
