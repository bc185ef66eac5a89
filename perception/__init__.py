"""Camera images to tactile frames: detect dots, fit the grid, measure displacement."""

from gelflow.perception.tracker import MarkerTracker, StartRefused, Tracked, TrackerConfig

__all__ = ["MarkerTracker", "StartRefused", "Tracked", "TrackerConfig"]
