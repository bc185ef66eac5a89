"""Gross slips and the smallest share that sticks of a tracking run."""

from dataclasses import dataclass
from typing import Any

from gelflow.perception.force.slip import SlipEstimate
from gelflow.perception.output.writers import TrackedImage


@dataclass
class SlipSummary:
    """Statistics over the images of a run."""

    gross_slips: int = 0
    first: str = ""  # image in which the first gross slip is found
    first_stamp: float | None = None  # [s]
    smallest_share: float | None = None  # that sticks, without gross slip
    friction: float | None = None  # last known coefficient
    observed: bool = False  # whether a gross slip showed it
    _slipping: bool = False

    def add(self, step: TrackedImage) -> None:
        """Add an image."""
        slip = step.slip
        if slip is None:
            self._slipping = False
            return
        if slip.gross and not self._slipping:
            self.gross_slips += 1
            if self.first_stamp is None:
                self.first, self.first_stamp = step.frame.name, step.frame.stamp
        self._slipping = slip.gross
        self.friction, self.observed = slip.friction, slip.friction_observed
        self._add_share(slip)

    def _add_share(self, slip: SlipEstimate) -> None:
        if slip.stick_share is not None and not slip.gross:
            smallest = self.smallest_share
            self.smallest_share = slip.stick_share if smallest is None else min(smallest, slip.stick_share)

    def to_json(self) -> dict[str, Any]:
        """The statistics as plain data."""
        return {
            "gross_slips": self.gross_slips,
            "first_gross_slip_at": self.first or None,
            "first_gross_slip_stamp": self.first_stamp,
            "smallest_stick_share": self.smallest_share,
            "friction": self.friction,
            "friction_observed": self.observed,
        }

    def text(self) -> str:
        """One line."""
        gross = "no gross slip"
        if self.first_stamp is not None:
            gross = f"{self.gross_slips} times gross slip, first at {self.first_stamp:.3f} s ({self.first})"
        if self.friction is None:
            return f"{gross}; friction unknown: no share that sticks, state it in the gel file"
        source = "observed in gross slip" if self.observed else "of the gel file"
        share = (
            f"; at least {100 * self.smallest_share:.0f} % stick otherwise" if self.smallest_share is not None else ""
        )
        return f"{gross}{share} (friction {self.friction:.2f}, {source})"
