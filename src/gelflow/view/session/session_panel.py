"""The part of a page that shows one recorded session."""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from gelflow.session.decision_replay import Comparison
from gelflow.session.records import Decision
from gelflow.view.page import Page
from gelflow.view.robot.robot_view import RobotView
from gelflow.view.session.curves import SAMPLES, Curves, read_curves
from gelflow.view.session.pad_pictures import decision_picture, pads_picture
from gelflow.view.session.recorded_session import RecordedSession
from gelflow.view.session.snapshot import Snapshot
from gelflow.view.session.snapshot_text import checks_text, snapshot_text
from gelflow.view.session.timeline import HEIGHT, WIDTH, Timeline
from gelflow.view.session.timeline_events import TimelineEvent

_DECISION_PICTURES = 32  # that are kept
_GROWTH = 1.0  # period in which curves of a growing session are extended [s]
_GROWTH_SAMPLES = 4  # of the curves of a growing session, in a second of robot time
_DRAWING_SHARE = 4  # pause after drawing, in durations of drawing
_SAME_TIME = 1e-6  # difference of times that is rounding [s]
_REDRAW = 5  # rounds of samples between two pictures of the curves


class SessionPanel:
    """Images, timeline, text and robot of one session. All methods are for the thread of the page.

    Parameters
    ----------
    page: where the panel is made
    panel: panel of viser that contains it
    session: the session
    decision_panel: where the flow maps of decisions are shown; None: below the timeline
    comparisons: the decisions of its replay; None: it is not replayed
    number: 0 for the first session of the page
    name: title of the panel
    """

    def __init__(
        self,
        page: Page,
        panel: Any,
        session: RecordedSession,
        *,
        decision_panel: Any = None,
        comparisons: Sequence[Comparison] | None = None,
        number: int = 0,
        name: str = "",
    ) -> None:
        self.session = session
        self.markers = True
        self._comparisons = {(c.recorded.insertion, c.recorded.attempt): c for c in comparisons or ()}
        self._replayed = comparisons is not None
        self._panel = panel
        self._robot: RobotView | None = None
        if session.cell is not None:
            self._robot = RobotView(page, session.cell, root=f"/robot {number}", opacity=0.45 if number else 1.0)
        panel_tab = panel.add_tab(name)
        with panel_tab:
            self._text = page.gui.add_markdown("")
            self._images = page.gui.add_image(np.full((10, 16, 3), 235, dtype=np.uint8), format="jpeg", jpeg_quality=85)
            self._time_image = page.gui.add_image(np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8), format="png")
        with decision_panel or panel_tab:
            blank = np.full((10, 16, 3), 255, dtype=np.uint8)
            self._decision_image = page.gui.add_image(blank, format="png", visible=False)
            self._checks_folder = page.gui.add_folder("Checks", visible=False)
            with self._checks_folder:
                self._checks = page.gui.add_markdown("")
        self._pictures: OrderedDict[tuple[int, int], Any] = OrderedDict()
        self._shown_decision: Decision | None = None
        self._timeline: Timeline | None = None
        self._drawn: Timeline | None = None
        self._time = session.start
        self._curves = Curves(session.start, session.end)
        self._grows = True  # the shown range grows with the session
        self._reading = threading.Event()
        self._reader: threading.Thread | None = None

    @property
    def events(self) -> list[TimelineEvent]:
        """Marks of the session, and of the differences of its replay."""
        return sorted([*self.session.timeline_events, *self._differences()], key=lambda event: event.time)

    def show_range(self, start: float, end: float) -> None:
        """Read and draw the curves from `start` to `end` [s] in the background.

        A range that reaches the end of the session grows with it.
        """
        self.close()
        self._grows = end > self.session.end - _SAME_TIME
        self._curves = curves = Curves(max(start, self.session.start), min(end, self.session.end))
        self._reading = threading.Event()
        self._reader = threading.Thread(target=self._read, args=(curves, self._reading), name="curves", daemon=True)
        self._reader.start()

    def show(self, time: float) -> Snapshot:
        """Show the session at a robot time [s]: first what is known at once, then the markers."""
        self._time = time = min(max(time, self.session.start), self.session.end)
        if self.markers and not self.session.markers.is_ready():
            self._show(self.session.at(time, markers=False))
        snapshot = self.session.at(time, markers=self.markers)
        self._show(snapshot)
        return snapshot

    def refresh(self) -> None:
        """Show what has been read in the background."""
        if self._timeline is not self._drawn:
            self._drawn = self._timeline
            self._show_time()

    def show_decision(self, decision: Decision | None) -> None:
        """Show the flow maps of a decision; drawing them takes a moment."""
        if decision is self._shown_decision or self.session.cell is None:
            return
        self._shown_decision = decision
        self._decision_image.visible = decision is not None
        if decision is None:
            return
        key = decision.insertion, decision.attempt
        if key not in self._pictures:
            comparison = self._comparison(decision) or Comparison(decision, decision.observation, decision.action)
            self._pictures[key] = decision_picture(comparison, self.session.cell.task.grid)
            if len(self._pictures) > _DECISION_PICTURES:
                self._pictures.popitem(last=False)
        self._decision_image.image = self._pictures[key]

    def show_end(self) -> None:
        """Show the end of a recording that has grown, with the curves as far as they are read."""
        self.close()
        if self._grows:
            self._curves.end = self.session.end
        self._draw(self._curves)
        self.refresh()

    def close(self) -> None:
        """End the reading in the background."""
        self._reading.set()
        if self._reader is not None:
            self._reader.join()
            self._reader = None

    def remove(self) -> None:
        """Remove the panel and the robot from the page."""
        self.close()
        self._panel.remove()
        if self._robot is not None:
            self._robot.remove()

    def _show(self, snapshot: Snapshot) -> None:
        self._images.image = pads_picture(snapshot.pads, markers=self.markers)
        if self._robot is not None:
            width = None if snapshot.gripper is None else float(snapshot.gripper["width"])
            self._robot.show(snapshot.joints, snapshot.flange, width, part_held=snapshot.part_held)
        self._checks.content = checks_text(snapshot)
        self._checks_folder.visible = bool(snapshot.checks)
        self._text.content = snapshot_text(snapshot, self.session, comparison=self._comparison(snapshot.decision))
        self._show_time()

    def _show_time(self) -> None:
        if self._drawn is not None:
            self._time_image.image = self._drawn.with_present(self._time)

    def _read(self, curves: Curves, ended: threading.Event) -> None:
        """In a thread: read the curves, and draw them from time to time; of a growing session also what is added."""
        growing = self.session.growing
        samples = _growth_samples(curves) if growing else SAMPLES
        for number, _ in enumerate(read_curves(self.session, curves, samples=samples)):
            if ended.is_set():
                return
            if number % _REDRAW == 0:
                self._draw(curves)
        self._draw(curves)
        while growing and not ended.wait(_GROWTH):
            growing = self.session.growing  # before the end is read: the last pass adds the last records
            begun = perf_counter()
            added = Curves(curves.end, self.session.end)
            if self._grows and added.end > added.start:
                # On a busy machine the curves are coarser instead of late: the first samples are spread evenly too.
                for _ in read_curves(self.session, added, samples=_growth_samples(added)):
                    if ended.is_set() or perf_counter() - begun > _GROWTH:
                        break
                curves.add(added)
            begun = perf_counter()
            self._draw(curves)
            ended.wait(_DRAWING_SHARE * (perf_counter() - begun))

    def _draw(self, curves: Curves) -> None:
        self._timeline = Timeline(curves, self.events, origin=self.session.start, topics=self.session.index.topics())

    def _comparison(self, decision: Decision | None) -> Comparison | None:
        return None if decision is None else self._comparisons.get((decision.insertion, decision.attempt))

    def _differences(self) -> list[TimelineEvent]:
        """Marks of the decisions that the replay did not repeat."""
        found = []
        for record in self.session.decisions:
            key = record.value.insertion, record.value.attempt
            comparison = self._comparisons.get(key)
            if self._replayed and (comparison is None or not comparison.identical):
                text = f"the replay of insertion {key[0]}, attempt {key[1]} differs"
                if comparison is None or comparison.skipped:
                    text = f"insertion {key[0]}, attempt {key[1]} could not be replayed"
                found.append(TimelineEvent(record.time, record.time, "difference", text, *key))
        return found


def _growth_samples(curves: Curves) -> int:
    """Samples of the curves of a growing session."""
    return min(round(_GROWTH_SAMPLES * (curves.end - curves.start)) + 1, SAMPLES)
