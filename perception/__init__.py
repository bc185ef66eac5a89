"""Camera images to tactile frames: detect dots, fit the grid, measure displacement."""

from gelflow.perception.tracker import MarkerTracker, TrackerConfig, TrackerInitError, TrackingResult

__all__ = ["MarkerTracker", "TrackerConfig", "TrackerInitError", "TrackingResult"]
