from .simulation_page import SimulationPage as SimulationPage
from .simulation_page import open as open

__all__ = ["SimulationPage", "open"]
