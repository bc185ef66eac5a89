"""The page of a training or of an evaluation: curves as they come, films of the policy, where its failures lie."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import GelflowError
from gelflow.view.page import DEFAULT_HOST, DEFAULT_PORT, Page

Image = NDArray[np.uint8]
_TICK = 0.05  # [s]
_LOOK = 2.0  # between two looks at the folder [s]
_LAST_FRAME = 1.5  # of a film [s]
_SLOWEST, _FASTEST = 1.0, 20.0  # pictures of a film per second
_PANEL_WIDTH = 620  # [px]


class Episodes(Protocol):
    """Episodes of a policy, in pictures and words."""

    @property
    def text(self) -> str: ...

    @property
    def failures(self) -> Image | None: ...

    @property
    def films(self) -> Mapping[str, Sequence[Image]]: ...

    @property
    def frames_per_second(self) -> float: ...


class Training(Protocol):
    """A training that is watched, or an evaluation; None stands for nothing new."""

    @property
    def name(self) -> str: ...

    def curve(self) -> Image | None: ...

    def evaluate(self, progress: Callable[[str], None]) -> Episodes | None: ...


class TrainingPage:
    """A page that follows a training, or shows an evaluation.

    Parameters
    ----------
    training: the training or evaluation
    host: address to bind to; any other than a loopback address needs the random token in `url`
    port: TCP port; 0 takes a free one

    Raises UsageError for an address in use, and without viser.
    """

    def __init__(self, training: Training, *, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT) -> None:
        self._training = training
        self._page = Page(host=host, port=port)
        self.url = self._page.url
        gui = self._page.gui
        panel = gui.add_panel()
        panel.dock_left()
        panel.set_width(_PANEL_WIDTH)
        blank = np.full((10, 16, 3), 255, dtype=np.uint8)
        with panel.add_tab(training.name):
            self._state = gui.add_markdown("reading the folder")
            self._result = gui.add_markdown("")
            self._curve = gui.add_image(blank, format="png", visible=False)
            self._failures = gui.add_image(blank, format="png", visible=False)
        self._choice = gui.add_dropdown("film", ("none yet",), initial_value="none yet")
        self._choice.on_update(lambda _: self._restart())
        self._caption = gui.add_markdown("Films show episodes of the policy.")
        self._episodes: Episodes | None = None
        self._frame, self._due = 0, 0.0
        self._problem = ""  # the reason why no new episodes are shown
        self._ending = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="training", daemon=True)
        self._watcher.start()

    def __enter__(self) -> "TrainingPage":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving the page."""
        self._ending.set()
        self._page.close()

    def run(self, *, until: Callable[[], bool] = lambda: False) -> None:
        """Play the films until `until()` is true or Ctrl-C."""
        while not until():
            self._play()
            time.sleep(_TICK)

    def _restart(self) -> None:
        self._frame, self._due = 0, 0.0

    def _play(self) -> None:
        """Show the next picture of the chosen film when its time has come."""
        episodes, now = self._episodes, time.perf_counter()
        film = [] if episodes is None else episodes.films.get(str(self._choice.value), [])
        if episodes is None or not film or now < self._due:
            return
        number = self._frame % len(film)
        self._page.show_picture(film[number])
        self._caption.content = f"{self._choice.value}: picture {number + 1} of {len(film)}"
        self._frame = number + 1
        rate = min(max(episodes.frames_per_second, _SLOWEST), _FASTEST)
        self._due = now + (_LAST_FRAME if number == len(film) - 1 else 1 / rate)

    def _watch(self) -> None:
        """In a thread: look at the training from time to time."""
        while not self._ending.is_set():
            try:
                self._show_curve()
                self._show_episodes(self._training.evaluate(self._show_state))
            except (GelflowError, OSError) as error:
                self._problem = f"**{error}**"
                self._show_state(self._problem)
            self._ending.wait(_LOOK)

    def _show_state(self, text: str) -> None:
        self._state.content = text

    def _show_curve(self) -> None:
        picture = self._training.curve()
        if picture is not None:
            self._curve.image, self._curve.visible = picture, True
            self._show_state(self._problem)

    def _show_episodes(self, episodes: Episodes | None) -> None:
        if episodes is None:
            return
        self._episodes, self._problem = episodes, ""
        self._show_state("")
        self._result.content = episodes.text
        if episodes.failures is not None:
            self._failures.image, self._failures.visible = episodes.failures, True
        names: Any = tuple(name for name, film in episodes.films.items() if film)
        chosen = self._choice.value if self._choice.value in names else next(iter(reversed(names)), "none yet")
        self._choice.options = names or ("none yet",)
        self._choice.value = chosen
        self._restart()
