from .live.live_view import LiveView as LiveView
from .session.recorded_session import RecordedSession as RecordedSession
from .session.session_page import SessionPage as SessionPage
from .simulation_page import SimulationPage as SimulationPage
from .simulation_page import open as open

__all__ = ["LiveView", "RecordedSession", "SessionPage", "SimulationPage", "open"]
