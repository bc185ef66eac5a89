from .client import ControllerReading as ControllerReading
from .client import WebServicesClient as WebServicesClient
from .monitor import ControllerMonitor as ControllerMonitor
from .monitor import ControllerState as ControllerState

__all__ = [
    "ControllerMonitor",
    "ControllerReading",
    "ControllerState",
    "WebServicesClient",
]
