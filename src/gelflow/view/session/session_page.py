"""The page of one recorded session, or of two side by side."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from gelflow.errors import UsageError
from gelflow.session.decision_replay import Comparison
from gelflow.view.page import DEFAULT_HOST, DEFAULT_PORT, Page
from gelflow.view.page_events import PageEvents
from gelflow.view.session.recorded_session import RecordedSession
from gelflow.view.session.session_panel import SessionPanel
from gelflow.view.session.snapshot import Snapshot

_TICK = 0.04  # [s] of the loop of `run`
_SPEEDS = ("0.1 ×", "0.25 ×", "1 ×", "4 ×", "16 ×")
_RANGES = ("whole recording", "this attempt", "10 s")
_START = "start"
_FROM_START = "starts of the recordings"
_PANEL_WIDTHS = (560, 440)  # of one session, and of each of two [px]
_SLIDER_STEP = 0.01  # [s]
_FOLLOW_PERIOD = 0.2  # between two pictures of a growing session [s]
_FOLLOW_SHARE = 0.25  # largest share of a core that these pictures take
_LONGEST_PAUSE = 1.0  # longest time between two of these pictures, on a busy machine [s]


class SessionPage:
    """A page of recorded sessions with a timeline that can be dragged.

    Parameters
    ----------
    sessions: one or two open sessions
    comparisons: the replay of the first session, None: it is not replayed
    host: address to bind to; any other than a loopback address needs the random token in `url`
    port: TCP port; 0 takes a free one
    page: an existing page, instead of a new one at host and port; it is not closed

    A session that is being recorded grows; the page follows its end until the time is dragged.

    Raises UsageError for more than two sessions, for an address in use, and without viser.
    """

    def __init__(
        self,
        sessions: Sequence[RecordedSession],
        *,
        comparisons: Sequence[Comparison] | None = None,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        page: Page | None = None,
    ) -> None:
        if not 1 <= len(sessions) <= 2:
            raise UsageError(f"a page shows one session or two, got {len(sessions)}")
        self._count = len(sessions)
        self._events = PageEvents()
        self._post = self._events.post
        self._own_page = page is None
        self._page = Page(host=host, port=port) if page is None else page
        self.url = self._page.url
        self.time = 0.0  # since the start of the first recording [s]
        self.playing = False
        self._speed = 1.0
        self._before = time.perf_counter()
        self._shown: float | None = None  # time that the panels show [s]
        self._behind = False  # records have been added that are not shown yet
        self._next_follow = 0.0
        self._offsets = [0.0] * len(sessions)  # of the time of each session [s]
        self._snapshots: list[Snapshot] = []
        same = len({session.name for session in sessions}) < len(sessions)
        self._names = [f"{s.reader.path.parent.name}/{s.name}" if same else s.name for s in sessions]
        self._sessions = sessions
        self._duration = self._longest()
        self._range = (0.0, self._duration)
        self._first_view = sessions[0].first_view - sessions[0].start
        self._live = any(session.growing for session in sessions)
        self._following = self._live  # the end of a session that is being recorded
        self._folder = self._page.gui.add_folder("Time")
        with self._folder:
            self._add_controls()
        single = len(sessions) == 1 and (self._live or sessions[0].decisions)
        folder = self._page.gui.add_folder("Decision and checks") if single else None
        self._decision_folder = folder
        self._panels = [
            self._add_panel(session, comparisons, number, folder) for number, session in enumerate(sessions)
        ]
        with self._folder:
            self._add_choices()
        self._show_range(_RANGES[0])
        self._go(self._first_view)

    def __enter__(self) -> "SessionPage":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving the page. The sessions stay open."""
        for panel in self._panels:
            panel.close()
        if self._own_page:
            self._page.close()

    def remove(self) -> None:
        """Remove everything from the page, which stays."""
        for panel in self._panels:
            panel.remove()
        self._folder.remove()
        if self._decision_folder is not None:
            self._decision_folder.remove()

    def go(self, seconds: float) -> None:
        """Go to a time since the start of the first recording [s]; from any thread, while `run` shows the page."""
        self._post(self._go_to, seconds)

    def run(self, *, until: Callable[[], bool] = lambda: False) -> None:
        """Show what the page asks for, until `until()` is true or Ctrl-C."""
        while not until():
            now = time.perf_counter()
            self.update()
            time.sleep(max(0.0, now + _TICK - time.perf_counter()))

    def update(self) -> None:
        """Show what the page has asked for, and what has been recorded, since the last call."""
        now = time.perf_counter()
        self._grow()
        changed = self._handle_events()
        if self.playing:
            self._go(min(self.time + self._speed * (now - self._before), self._range[1]), moved=True)
        elif not changed or self._live:
            self._settle()
        self._before = now
        for panel in self._panels:
            panel.refresh()

    def show_end(self) -> None:
        """Show the end of a recording that has grown until now."""
        self.update()
        for panel in self._panels:
            panel.show_end()

    def _grow(self) -> None:
        """Add what has been recorded; show its end when it is followed."""
        if not self._live:
            return
        grown = [panel.session.refresh() for panel in self._panels]
        if any(grown):
            self._behind = True
            self._extend()
        if self._behind and self._following and time.perf_counter() >= self._next_follow:
            self._behind = False
            now, used = time.perf_counter(), time.thread_time()
            self._go(self._duration, moved=True)
            pause = (time.thread_time() - used) / _FOLLOW_SHARE
            self._next_follow = now + min(max(_FOLLOW_PERIOD, pause), _LONGEST_PAUSE)

    def _extend(self) -> None:
        """Extend the timeline to the present end, unless it shows an earlier range."""
        at_end = self._range[1] == self._duration
        self._duration = self._longest()
        if at_end:
            start = self._range[0]
            self._range = (start, self._duration)
            self._slider.max = max(round(self._duration, 2), round(start, 2) + _SLIDER_STEP)
        self._refresh_marks()

    def _longest(self) -> float:
        """Time of the page at which the last session ends [s]."""
        return max(s.end - s.start - offset for s, offset in zip(self._sessions, self._offsets, strict=True))

    def _add_panel(
        self, session: RecordedSession, comparisons: Sequence[Comparison] | None, number: int, folder: Any
    ) -> SessionPanel:
        panel = self._page.gui.add_panel()
        if number == 0:
            panel.dock_left()
        else:
            panel.dock_right()
        panel.set_width(_PANEL_WIDTHS[self._count - 1])
        return SessionPanel(
            self._page, panel, session, decision_panel=folder,
            comparisons=comparisons if number == 0 else None, number=number,
            name=self._names[number],
        )  # fmt: skip

    def _add_controls(self) -> None:
        gui = self._page.gui
        self._slider = gui.add_slider("time [s]", 0.0, max(self._duration, _SLIDER_STEP), _SLIDER_STEP, 0.0)
        self._slider.on_update(self._dragged)
        if self._live:
            gui.add_button("Follow the robot").on_click(lambda _: self._post(self._follow))
        self._play = gui.add_button("Play")
        self._play.on_click(lambda _: self._post(self._toggle))
        speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1 ×")
        speed.on_update(lambda event: self._post(setattr, self, "_speed", float(event.target.value.split()[0])))
        jump = gui.add_button_group("event", ("Previous", "Next"))
        jump.on_click(lambda event: self._post(self._jump, event.target.value == "Next"))

    def _add_choices(self) -> None:
        """Choices that depend on the contents of the sessions."""
        gui = self._page.gui
        self._add_marks(gui)
        shown = gui.add_dropdown("timeline shows", _RANGES, initial_value=_RANGES[0])
        shown.on_update(lambda event: self._post(self._show_range, event.target.value))
        if len(self._panels) == 2:
            align = gui.add_dropdown("same time at", (_FROM_START, *self._common_attempts()))
            align.on_update(lambda event: self._post(self._align, event.target.value))
        markers = gui.add_checkbox("markers", initial_value=True)
        markers.on_update(lambda event: self._post(self._set_markers, event.target.value))

    def _add_marks(self, gui: Any) -> None:
        """The list of all events of the first session, to jump to."""
        self._marks: dict[str, float] = {}
        self._chosen = gui.add_dropdown("go to", (_START,), initial_value=_START)
        self._chosen.on_update(self._mark_chosen)
        self._refresh_marks()

    def _refresh_marks(self) -> None:
        first = self._panels[0]
        found = {
            f"{event.time - first.session.start:.2f} s {event.text}": event.time - first.session.start
            for event in first.events
        }
        if list(found) != list(self._marks):
            self._marks = found
            self._chosen.options = (_START, *found)

    def _mark_chosen(self, event: Any) -> None:
        if event.client is not None:  # not a change of the list
            self._post(self._go_to_mark, event.target.value)

    def _go_to_mark(self, name: str) -> None:
        self._go_to(self._marks.get(name, self._first_view))

    def _go_to(self, seconds: float) -> None:
        self._following = False
        self._go(seconds)

    def _follow(self) -> None:
        self._following = self._behind = True
        self._set_playing(False)

    def _dragged(self, event: Any) -> None:
        if event.client is not None:  # a person has moved it, not this program
            self._post(self._drag, float(event.target.value))

    def _drag(self, seconds: float) -> None:
        self._following = False
        self._go(seconds, dragged=True)

    def _handle_events(self) -> bool:
        """Handle what the page has sent; of several times only the last is shown."""
        self._events.handle()
        return self._show_if_moved()

    def _toggle(self) -> None:
        self._following = False
        if not self.playing and not self._range[0] <= self.time < self._range[1]:
            self.time = self._range[0]
        self._set_playing(not self.playing)

    def _set_playing(self, playing: bool) -> None:
        self.playing = playing
        self._play.label = "Pause" if playing else "Play"

    def _set_markers(self, markers: bool) -> None:
        for panel in self._panels:
            panel.markers = markers
        self._shown = None

    def _go(self, seconds: float, moved: bool = False, dragged: bool = False) -> None:
        """Go to a time [s] of the page."""
        self.time = min(max(seconds, 0.0), self._duration)
        if not self._range[0] <= self.time <= self._range[1]:
            self._show_range(_RANGES[0])
        if moved and self.time >= self._range[1]:
            self._set_playing(False)
        if not dragged:
            self._slider.value = round(self.time, 2)
        if moved:
            self._show_if_moved()

    def _show_if_moved(self) -> bool:
        if self._shown == self.time:
            return False
        self._shown = self.time
        self._snapshots = [
            panel.show(panel.session.start + self.time + offset)
            for panel, offset in zip(self._panels, self._offsets, strict=True)
        ]
        return True

    def _settle(self) -> None:
        """Show what takes longer, while nothing moves."""
        for panel, snapshot in zip(self._panels, self._snapshots, strict=True):
            panel.show_decision(snapshot.decision)

    def _jump(self, forward: bool) -> None:
        self._following = False
        times = sorted(self._marks.values())
        if forward:
            self._go(next((t for t in times if t > self.time + 1e-3), self._duration))
        else:
            self._go(next((t for t in reversed(times) if t < self.time - 1e-3), 0.0))

    def _show_range(self, name: str) -> None:
        start, end = 0.0, self._duration
        if name == _RANGES[1]:
            start, end = self._attempt_range()
        elif name == _RANGES[2]:
            start = min(max(self.time - 5.0, 0.0), max(self._duration - 10.0, 0.0))
            end = min(start + 10.0, self._duration)
        self._range = start, end
        self._slider.min, self._slider.max = round(start, 2), max(round(end, 2), round(start, 2) + _SLIDER_STEP)
        for panel, offset in zip(self._panels, self._offsets, strict=True):
            panel.show_range(panel.session.start + start + offset, panel.session.start + end + offset)

    def _attempt_range(self) -> tuple[float, float]:
        """The attempt of the first session at the present time, or the last before; without one the whole recording."""
        origin = self._panels[0].session.start
        spans = [(m.time - origin, m.end - origin) for m in self._panels[0].events if m.end > m.time]
        before = [span for span in spans if span[0] <= self.time]
        return before[-1] if before else spans[0] if spans else (0.0, self._duration)

    def _common_attempts(self) -> list[str]:
        """Names of the attempts that both sessions have."""
        first, second = (_attempt_starts(panel) for panel in self._panels)
        return [_attempt_name(key) for key in first if key in second]

    def _align(self, name: str) -> None:
        first, second = (_attempt_starts(panel) for panel in self._panels)
        offset = next((second[key] - first[key] for key in first if _attempt_name(key) == name and key in second), 0.0)
        self._offsets[1] = offset
        self._duration = self._longest()
        self._shown = None
        self._show_range(_RANGES[0])
        self._go(self.time)


def _attempt_starts(panel: SessionPanel) -> dict[tuple[int | None, int | None], float]:
    """Starts of the attempts [s] since the start of the recording."""
    return {(m.insertion, m.attempt): m.time - panel.session.start for m in panel.events if m.end > m.time}


def _attempt_name(key: tuple[int | None, int | None]) -> str:
    return f"insertion {key[0]}, attempt {key[1]}"
