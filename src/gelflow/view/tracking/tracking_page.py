"""A page that shows tracked images while they arrive: markers, forces over time, and a new zero on a key."""

import threading
import time
from collections import deque
from typing import Any

import numpy as np

from gelflow.figures import BLUE, VERMILION
from gelflow.perception.output.forces import force_text
from gelflow.perception.output.writers import TrackedImage, overlay
from gelflow.view.page import DEFAULT_HOST, DEFAULT_PORT, Page

_SECONDS = 20.0  # of the curves
_POINTS = 20_000  # kept for the curves: 1000 images a second
_PERIOD = 1 / 15  # between two pictures [s]
_CURVE_PERIOD = 0.2  # between two curves [s]
_MAX_SHARE = 0.25  # of the time that the page takes
_PANEL_WIDTH = 420  # [px]


class TrackingPage:
    """A page that follows tracked images, as a writer of `gelflow track`.

    Parameters
    ----------
    name: of the source
    magnify: length of the arrows relative to the displacements
    forces: whether the images have forces; the curves show them, otherwise the displacements
    paced: whether `add` waits until the time of the image, for recorded images
    host: address to bind to; any other than a loopback address needs the random token in `url`
    port: TCP port; 0 takes a free one

    A picture is skipped where drawing would take more than a quarter of the time. Raises UsageError for an
    address in use, and without viser.
    """

    def __init__(
        self,
        name: str,
        *,
        magnify: float,
        forces: bool,
        paced: bool = False,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
    ) -> None:
        self._page = Page(host=host, port=port)
        from viser import uplot  # deferred: optional; `Page` says how to install it

        self.url = self._page.url
        self._magnify, self._forces, self._paced = magnify, forces, paced
        self._first: tuple[float, float] | None = None  # stamp of the first image, and its time [s]
        self._zero = threading.Event()
        self._next, self._next_curve = 0.0, 0.0
        names = ("normal [N]", "shear [N]") if forces else ("largest [px]", "mean [px]")
        self._curve: deque[tuple[float, float, float]] = deque(maxlen=_POINTS)  # time [s], then both curves
        gui = self._page.gui
        panel = gui.add_panel()
        panel.dock_left()
        panel.set_width(_PANEL_WIDTH)
        with panel.add_tab("Tracking"):
            gui.add_markdown(f"**{name}**")
            self._text = gui.add_markdown("waiting for images")
            series: list[Any] = [uplot.Series(label="time [s]")]
            series += [uplot.Series(label=n, stroke=c, width=2) for n, c in zip(names, (BLUE, VERMILION), strict=True)]
            self._plot = gui.add_uplot(
                (np.zeros(1), np.zeros(1), np.zeros(1)),
                tuple(series),
                scales={"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)},
                aspect=1.5,
            )
            button = gui.add_button("Zero (Z)", hint="the present image is the new state of rest")
            self._note = gui.add_markdown("")
        button.on_click(lambda _: self._zero.set())
        self._page.gui.add_command("Zero: the present image is the new state of rest", hotkey="Z").on_trigger(
            lambda _: self._zero.set()
        )

    def take_zero_request(self) -> bool:
        """Whether somebody asked for a new zero since the last call."""
        asked = self._zero.is_set()
        self._zero.clear()
        return asked

    def zeroed(self, *, done: bool) -> None:
        """Say below the button whether the present image became the new zero."""
        since = self._curve[-1][0] if self._curve else 0.0
        refused = "The grid is not clear in this image, so the zero is as before. Release the gel and try again."
        self._note.content = f"zero at {since:.1f} s" if done else refused

    def add(self, step: TrackedImage) -> None:
        """Show one image, if the next picture is due and a browser shows the page."""
        if self._first is None:
            self._first = step.frame.stamp, time.perf_counter()
        self._curve.append((step.frame.stamp - self._first[0], *self._values(step)))
        if self._paced:
            time.sleep(max(0.0, self._first[1] + self._curve[-1][0] - time.perf_counter()))
        begun = time.perf_counter()
        if begun < self._next or not self._page.watched():
            return
        picture = overlay(step, magnify=self._magnify, forces=self._forces)
        self._page.show_picture(picture[..., ::-1])
        if begun >= self._next_curve:
            self._show_curve()
            self._text.content = self._words(step)
            self._next_curve = begun + _CURVE_PERIOD
        taken = time.perf_counter() - begun
        self._next = begun + max(_PERIOD, taken / _MAX_SHARE)

    def close(self) -> None:
        """Stop serving the page."""
        self._page.close()

    def _values(self, step: TrackedImage) -> tuple[float, float]:
        if self._forces:
            force = step.force
            return (np.nan, np.nan) if force is None else (force.normal, float(np.linalg.norm(force.shear)))
        lengths = np.hypot(*step.tracked.displacement[step.tracked.valid].T)
        return (float(lengths.max()), float(lengths.mean())) if lengths.size else (np.nan, np.nan)

    def _show_curve(self) -> None:
        data = np.array(self._curve)
        data = data[data[:, 0] > data[-1, 0] - _SECONDS]
        self._plot.data = tuple(np.ascontiguousarray(column) for column in data.T)

    def _words(self, step: TrackedImage) -> str:
        tracked = step.tracked
        lines = [f"image {step.number + 1}, {self._curve[-1][0]:.1f} s"]
        lines.append(f"{tracked.valid.sum()} of {tracked.valid.size} markers measured")
        if self._forces:
            lines.append(force_text(step.force).replace("+-", "±"))
        return "\n\n".join(lines)
