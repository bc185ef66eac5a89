"""Pictures of simulated environments as arrays, on machines without display and OpenGL."""

import weakref
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import arguments
from gelflow.sim.drawing.annotations import ForceScales, annotate, force_scales, panel_width, round_scale
from gelflow.sim.drawing.camera import Camera, framing_camera
from gelflow.sim.drawing.ray_caster import RayCaster, View
from gelflow.sim.drawing.scene_drawing import Polyline, SceneDrawing, scene_drawing
from gelflow.sim.simulator import Simulator

DEFAULT_SIZE = (640, 480)
_MAX_PIXELS = 50_000_000
_TILES = 4.0  # lines on planes across the scene, about


class Renderer:
    """Draws environments of one simulator; what does not change between two pictures is prepared once."""

    def __init__(self, sim: Simulator) -> None:
        self._sim = weakref.proxy(sim)
        self._key: tuple[bytes, ...] = ()
        self._caster: RayCaster | None = None
        self._start: SceneDrawing | None = None

    def picture(
        self,
        env: int = 0,
        size: tuple[int, int] = DEFAULT_SIZE,
        camera: Camera | str = "oblique",
        *,
        title: str = "",
        polylines: Sequence[Polyline] = (),
    ) -> NDArray[np.uint8]:
        """See `render`."""
        drawing = scene_drawing(self._sim, env)
        if not isinstance(camera, Camera):
            # Framed at the start of the scene and with the polylines, so that the camera rests while the bodies move.
            camera = self.camera([self._at_start()], camera, size, polylines=polylines)
        return self.draw(drawing, size, camera, title=title, polylines=polylines)

    def camera(
        self, drawings: list[SceneDrawing], view: str, size: tuple[int, int], *, polylines: Sequence[Polyline] = ()
    ) -> Camera:
        """A camera with a view of `VIEWS` that has all drawings and polylines beside the panels of the pads."""
        width, height = _checked_size(size)
        return framing_camera(
            drawings, view, aspect=(width - _panels(drawings[0], width)) / height, polylines=polylines
        )

    def draw(
        self,
        drawing: SceneDrawing,
        size: tuple[int, int],
        camera: Camera,
        *,
        scales: ForceScales | None = None,
        title: str = "",
        polylines: Sequence[Polyline] = (),
    ) -> NDArray[np.uint8]:
        """A picture of a drawing of this simulator; `scales` of the forces are by default chosen for the picture."""
        width, height = _checked_size(size)
        view = View(camera, (width, height), ((width - _panels(drawing, width)) / 2, height / 2))
        tile = round_scale(camera.distance * np.tan(np.radians(camera.fov / 2)) / _TILES)
        picture, seen = self._caster_for(drawing).draw(drawing, view, tile=tile)
        annotate(
            picture, drawing, view,
            seen=seen, scales=scales or force_scales([drawing]), tile=tile, title=title, polylines=polylines,
        )  # fmt: skip
        return picture

    def _at_start(self) -> SceneDrawing:
        if self._start is None:
            self._start = scene_drawing(Simulator(self._sim.scene))
        return self._start

    def _caster_for(self, drawing: SceneDrawing) -> RayCaster:
        """The caster of the geometries; a new one where sizes or poses on the bodies have changed."""
        key = tuple(
            part.tobytes() for geom in drawing.geoms for part in (geom.size, geom.pose.position, geom.pose.quaternion)
        )
        if self._caster is None or key != self._key:
            self._caster, self._key = RayCaster(drawing.geoms, len(drawing.poses)), key
        return self._caster


_renderers: "weakref.WeakKeyDictionary[Simulator, Renderer]" = weakref.WeakKeyDictionary()


def render(
    sim: Simulator,
    env: int = 0,
    size: tuple[int, int] = DEFAULT_SIZE,
    camera: Camera | str = "oblique",
    *,
    title: str = "",
    polylines: Sequence[Polyline] = (),
) -> NDArray[np.uint8]:
    """A picture of an environment at its present state: RGB, shape (height, width, 3).

    Shows bodies, contact forces as arrows at the points where they act (on the body that has the contact points), the
    markers of each pad, and per pad a panel with the normal force of each marker as colour and its shear force as
    arrow, seen from outside with the fingertip down. Scales and units are in the picture. Needs neither display nor
    OpenGL.

    Parameters
    ----------
    sim: a simulator of a `Scene`
    env: number of the environment
    size: width and height [px]
    camera: a `Camera`, or a view that is framed to the scene at its start: "oblique", "front", "side" or "top"
    title: a line at the top
    polylines: lines in the world

    Raises UsageError for a wrong environment, size, view or polyline, and for a simulator of a core model.
    """
    arguments.check_type("sim", sim, Simulator, "a Simulator")
    if not isinstance(polylines, Sequence) or not all(isinstance(polyline, Polyline) for polyline in polylines):
        raise UsageError(f"polylines must be a list of Polyline, got {arguments.shown(polylines)}")
    arguments.check_type("title", title, str, "a string")
    return _renderers.setdefault(sim, Renderer(sim)).picture(env, size, camera, title=title, polylines=polylines)


def _panels(drawing: SceneDrawing, width: int) -> int:
    """Width of the panels of the pads [px]."""
    return panel_width(width) if drawing.pads else 0


def _checked_size(size: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = size
    except (TypeError, ValueError):
        raise UsageError(f"size must be width and height in pixels, got {arguments.shown(size)}") from None
    width = arguments.integer("width", width, minimum=64)
    height = arguments.integer("height", height, minimum=64)
    if width * height > _MAX_PIXELS:
        raise UsageError(f"size must be at most {_MAX_PIXELS} pixels, got {width} x {height}")
    return width, height
