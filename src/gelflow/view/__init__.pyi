from .live.live_view import LiveView as LiveView
from .session.recorded_session import RecordedSession as RecordedSession
from .session.session_page import SessionPage as SessionPage
from .simulation_page import SimulationPage as SimulationPage
from .simulation_page import open as open
from .training.training_page import TrainingPage as TrainingPage

__all__ = ["LiveView", "RecordedSession", "SessionPage", "SimulationPage", "TrainingPage", "open"]
