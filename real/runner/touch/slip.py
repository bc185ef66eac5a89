"""Detection of slip in the grip: the arm moves on under contact, and the shear of the gels no longer grows."""

from collections import deque

_WINDOW = 0.15e-3  # motion of the arm over which the growth of the shear is measured [m]
_LEAST_GROWTH = 0.5  # in that window, as a multiple of the contact threshold
_LEAST_SHARE = 0.3  # of the largest growth in such a window so far: the shear of a soft arm grows slowly, but evenly


class SlipMonitor:
    """Compares the arm's motion with the shear of the pads during one descent."""

    def __init__(self, contact_threshold: float) -> None:
        self._threshold = contact_threshold
        self._recent: deque[tuple[float, float]] = deque()
        self._largest_growth = 0.0
        self._onset: float | None = None
        self._depth = 0.0
        self.slipped = False

    @property
    def distance(self) -> float:
        """Upper bound of the slip [m]: motion of the arm since contact began; 0 without slip."""
        return self._depth - self._onset if self.slipped and self._onset is not None else 0.0

    def add(self, depth: float, shear: float) -> bool:
        """Add the arm's depth [m] and the mean shear of the pads [mm]; returns whether the part slips."""
        self._depth = depth
        if self._onset is None and shear > self._threshold:
            self._onset = depth
        self._recent.append((depth, shear))
        while len(self._recent) > 1 and self._recent[1][0] <= depth - _WINDOW:
            self._recent.popleft()
        first_depth, first_shear = self._recent[0]
        if depth - first_depth >= _WINDOW:
            growth = shear - first_shear
            self._largest_growth = max(self._largest_growth, growth)
            under_contact = self._onset is not None and depth - self._onset >= _WINDOW
            if under_contact and growth < min(_LEAST_GROWTH * self._threshold, _LEAST_SHARE * self._largest_growth):
                self.slipped = True
        return self.slipped
