"""A page that shows a simulator: in a loop of one's own (`open`), or driven from the page (`SimulationPage.run`)."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gelflow.errors import UsageError
from gelflow.sim import arguments
from gelflow.sim.benchmark.describe import Description, describe
from gelflow.sim.drawing.scene_drawing import SceneDrawing, scene_drawing
from gelflow.sim.scene import Scene
from gelflow.sim.scene.mjcf.mechanics import WORLD
from gelflow.sim.scene.start_controls import start_controls
from gelflow.sim.simulator import STATUS_MESSAGES, Simulator
from gelflow.view.body_text import body_text
from gelflow.view.joint_sliders import Sliders, control_ranges, coordinates, read_coordinate, write_coordinate
from gelflow.view.page import DEFAULT_HOST, DEFAULT_PORT, Page
from gelflow.view.page_events import PageEvents
from gelflow.view.scene_view import SceneView

MAX_RATE = 20.0  # of the pictures on the page [1/s]
MAX_SHARE = 0.2  # of the time of the caller that the page takes
_IDLE_RATE = 1.0  # while no browser is open [1/s]
_TICK = 0.02  # [s] of the loop of `run`
_MARKERS_OBSERVE = (
    "Markers only observe, with a stiffness of their own: the sum over a pad differs from the contact force."
)
_SPEEDS = ("0.01 ×", "0.1 ×", "0.25 ×", "1 ×", "4 ×")
_FEW_SLIDERS = 12


class SimulationPage:
    """A page that follows one environment of a simulator.

    Parameters
    ----------
    sim: a simulator of a `Scene`
    env: number of the environment that is shown first
    host: address to bind to; any other than a loopback address needs the random token in `url`
    port: TCP port; 0 takes a free one
    controls: whether the page has play, step, speed and sliders, for `run`

    Raises UsageError for a wrong environment, a simulator of a core model, an address in use, and without viser.
    """

    def __init__(
        self,
        sim: Simulator,
        *,
        env: int = 0,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        controls: bool = False,
    ) -> None:
        arguments.check_type("sim", sim, Simulator, "a Simulator")
        drawing = scene_drawing(sim, env)
        self._sim, self._scene = sim, sim.scene
        self.env = env
        self._events = PageEvents()
        self._post = self._events.post
        self._next = 0.0
        self._steps = 0  # taken by `run`
        self.playing = False
        self._speed = 1.0
        self._u = np.tile(start_controls(self._scene), (sim.num_envs, 1))
        self._description: Description | None = None
        start = drawing if not isinstance(self._scene, Scene) else _start_drawing(self._scene)
        self._page = Page(host=host, port=port)
        self.url = self._page.url
        self._view = SceneView(self._page, self._scene, start, clicked=lambda body: self._post(self._describe, body))
        self._make_controls(playable=controls)
        self._show(drawing)

    def __enter__(self) -> "SimulationPage":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving the page."""
        self._page.close()

    def update(self) -> bool:
        """Show the present state, unless the page was updated a moment ago; True if it was shown.

        At most `MAX_RATE` times per second and `MAX_SHARE` of the caller's time; the other calls return at once. Call
        it as often as convenient, from the thread that steps the simulator.
        """
        now = time.perf_counter()
        if now < self._next:
            return False
        self._handle_events()
        self._show(scene_drawing(self._sim, self.env))
        end = time.perf_counter()
        rate = MAX_RATE if self._page.watched() else _IDLE_RATE
        self._next = max(now + 1 / rate, end + (end - now) * (1 / MAX_SHARE - 1))
        return True

    def run(self, *, until: Callable[[], bool] = lambda: False) -> None:
        """Step the simulator as selected by the buttons of the page, until `until()` is true or Ctrl-C."""
        before, due = time.perf_counter(), 0.0
        while not until():
            self._handle_events()
            now = time.perf_counter()
            due = min(due + self._speed * (now - before), 5 * _TICK * max(self._speed, 1)) if self.playing else 0.0
            before = now
            while due >= self._scene.step and time.perf_counter() < now + 2 * _TICK:
                self._step()
                due -= self._scene.step
            self.update()
            time.sleep(max(0.0, now + _TICK - time.perf_counter()))

    def _handle_events(self) -> None:
        if self._events.handle():
            self._next = 0.0

    def _step(self) -> None:
        self._sim.step(self._u)
        self._steps += 1
        if self._sim.status.any():
            self._set_playing(False)

    def _set_playing(self, playing: bool) -> None:
        self.playing = playing
        self._play.label = "Pause" if playing else "Play"

    def _make_controls(self, *, playable: bool) -> None:
        gui = self._page.gui
        self._status = gui.add_markdown("")
        if self._sim.num_envs > 1:
            number = gui.add_number("environment", self.env, min=0, max=self._sim.num_envs - 1, step=1)
            number.on_update(lambda event: self._post(self._choose_env, event.target.value))
        if playable:
            self._add_playing(gui)
        self._body = gui.add_markdown("Click a body to see its description.")
        if self._scene.pads:
            with gui.add_folder("Pads"):
                self._panels = gui.add_image(self._view.panels(scene_drawing(self._sim, self.env)), format="png")
                gui.add_markdown(_MARKERS_OBSERVE)
        with gui.add_folder("Forces"):
            self._legend = gui.add_markdown(self._view.legend())
            choices = [("contacts", "contact forces"), ("labels", "labels")]
            if self._scene.pads:
                choices.append(("markers", "pad markers"))
            for name, label in choices:
                box = gui.add_checkbox(label, initial_value=True)
                box.on_update(lambda event, name=name: self._post(setattr, self._view.shown, name, event.target.value))
            gui.add_button("Reset force scales").on_click(lambda _: self._post(self._view.reset_scales))
        self._coordinates = coordinates(self._scene)
        self._joints: Sliders | None = None
        self._controls: Sliders | None = None
        if playable:
            self._add_sliders(gui)

    def _add_playing(self, gui: Any) -> None:
        self._play = gui.add_button("Play")
        self._play.on_click(lambda _: self._post(lambda: self._set_playing(not self.playing)))
        gui.add_button("Single step").on_click(lambda _: self._post(self._single_step))
        gui.add_button("Reset").on_click(lambda _: self._post(self._reset))
        speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1 ×")
        speed.on_update(lambda event: self._post(setattr, self, "_speed", float(event.target.value.split()[0])))

    def _add_sliders(self, gui: Any) -> None:
        values = [read_coordinate(self._sim, self.env, c) for c in self._coordinates]
        rows = [(c.label, x, c.low, c.high) for c, x in zip(self._coordinates, values, strict=True)]
        self._joints = Sliders(
            gui, "Joints", rows, lambda i, x: self._post(self._move, i, x), expanded=len(rows) <= _FEW_SLIDERS
        )
        names = [actuator.name for actuator in self._scene.actuators]
        controls = [(name, *ends) for name, ends in zip(names, control_ranges(self._scene), strict=True)]
        if controls:
            self._controls = Sliders(
                gui, "Controls", controls, lambda i, x: self._post(self._control, i, x), expanded=False
            )

    def _choose_env(self, env: int) -> None:
        self.env = min(max(int(env), 0), self._sim.num_envs - 1)
        if self._controls is not None:
            self._controls.show(self._u[self.env].tolist())

    def _single_step(self) -> None:
        self._set_playing(False)
        self._step()

    def _reset(self) -> None:
        self._set_playing(False)
        self._sim.reset()
        self._u[:] = start_controls(self._scene)
        self._steps = 0
        self._view.reset_scales()
        if self._controls is not None:
            self._controls.show(self._u[self.env].tolist())

    def _move(self, number: int, value: float) -> None:
        write_coordinate(self._sim, self.env, self._coordinates[number], value)

    def _control(self, number: int, value: float) -> None:
        self._u[self.env, number] = value

    def _describe(self, body: int) -> None:
        if self._description is None:
            try:
                self._description = describe(self._scene)
            except UsageError as error:  # the files of the scene have changed or are gone
                self._body.content = str(error)
                return
        self._body.content = body_text(self._description, "world" if body == WORLD else self._scene.bodies[body].name)

    def _show(self, drawing: SceneDrawing) -> None:
        self._view.show(drawing)
        self._legend.content = self._view.legend()
        if self._scene.pads:
            self._panels.image = self._view.panels(drawing)
        if self._joints is not None:
            self._joints.show([read_coordinate(self._sim, self.env, c) for c in self._coordinates])
        self._status.content = self._state_text()

    def _state_text(self) -> str:
        failed = int(self._sim.status[self.env])
        taken = f", {self._steps} steps, {self._steps * self._scene.step:.3f} s" if self._joints is not None else ""
        state = "" if not failed else f"; **stopped: {STATUS_MESSAGES[failed]}**"
        return f"**{self._scene.name}**, environment {self.env} of {self._sim.num_envs}{taken}{state}"


def _start_drawing(scene: Scene) -> SceneDrawing:
    """The scene at its start."""
    return scene_drawing(Simulator(scene))


def open(sim: Simulator, *, env: int = 0, host: str = DEFAULT_HOST, port: int = DEFAULT_PORT) -> SimulationPage:
    """Serve a page of a simulator, for a loop of one's own; a context manager.

        with gelflow.view.open(sim) as viewer:
            print(viewer.url)
            for u in controls:
                sim.step(u)
                viewer.update()

    Parameters and errors are those of `SimulationPage`.
    """
    return SimulationPage(sim, env=env, host=host, port=port)
