"""Pictures: bodies, shadows and forces are at the pixels where geometry puts them."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import gelflow.sim as gs
from gelflow.errors import UsageError
from gelflow.sim.drawing.annotations import marker_colors, quantity, round_scale
from gelflow.sim.drawing.camera import VIEWS, framing_camera
from gelflow.sim.drawing.film import film_pictures, record_rollout
from gelflow.sim.drawing.ray_caster import RayCaster, View
from gelflow.sim.drawing.scene_drawing import Polyline, scene_drawing

VERMILION = np.array([213, 94, 0])


def near(picture: NDArray[np.uint8], color: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.asarray(np.abs(picture.astype(int) - color).max(-1) < 30)


def test_distances_of_pixels_are_those_of_the_geometry() -> None:
    sim = gs.Simulator(gs.load_scene("pushing"))
    drawing = scene_drawing(sim)
    camera = gs.Camera((0.05, 0.0, 0.025), 0.4, azimuth=0.0, elevation=0.0)  # looks along -x at the box
    view = View(camera, (160, 120), (80.0, 60.0))
    picture, seen = RayCaster(drawing.geoms, len(drawing.poses)).draw(drawing, view, tile=0.05)
    assert picture.shape == (120, 160, 3)
    np.testing.assert_allclose(seen[60, 80], 0.4 - 0.025, rtol=1e-4)  # the face of the box
    pixel, depth = view.project(np.array([[0.05, 0.0, 0.025], [0.05, 0.01, 0.025]]))
    np.testing.assert_allclose(pixel[0], [80, 60])
    assert pixel[1, 0] > 80  # y points to the right, seen from +x
    np.testing.assert_allclose(depth, 0.4)


@pytest.mark.parametrize("name", gs.scene_names())
def test_every_scene_has_a_picture_that_is_not_blank(name: str) -> None:
    sim = gs.Simulator(gs.load_scene(name))
    picture = gs.render(sim, size=(320, 240))
    assert picture.shape == (240, 320, 3) and picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200


@pytest.mark.parametrize("size", [(64, 64), (65, 300), (300, 64)])
def test_small_pictures(size: tuple[int, int]) -> None:
    sim = gs.Simulator(gs.load_scene("insertion"))
    assert gs.render(sim, size=size).shape == (size[1], size[0], 3)


def test_contact_force_is_an_arrow_that_appears_with_the_contact() -> None:
    scene = gs.load_scene("pushing")
    sim = gs.Simulator(scene)
    sim.q[:, sim.joint_q("box_z") if "box_z" in sim.model.joint_names else 0] += 0.0
    for _ in range(20):
        sim.step(np.zeros(scene.nu))
    assert scene_drawing(sim).contacts
    camera = gs.Camera((0.05, 0.0, 0.025), 0.4)
    arrow = near(gs.render(sim, size=(320, 240), camera=camera), VERMILION)
    assert arrow[:180].sum() > 30  # above the legend
    rows = np.flatnonzero(arrow[:180].any(1))
    assert np.ptp(rows) > 20  # upwards: the ground carries the box


def test_distance_of_lines_is_written_where_a_plane_has_them(tmp_path: Path) -> None:
    texts = []
    for plane in ("", '<geom type="plane" size="1 1 0.1"/>'):
        (tmp_path / "arm.xml").write_text(f"""<mujoco><worldbody>{plane}
          <body pos="0 0 1"><joint/><geom size="0.1"/></body></worldbody></mujoco>""")
        sim = gs.Simulator(gs.load_scene(tmp_path / "arm.xml"))
        picture = gs.render(sim, size=(320, 240), camera=gs.Camera((0.0, 0.0, 1.0), 0.5, elevation=-60.0))
        texts.append((picture[225:238, 72:200] < 128).any())  # seen from below, in front of the sky
    assert texts == [False, True]


def test_pad_panel_shows_normal_forces_as_colours() -> None:
    scene = gs.load_scene("rolling", overrides={"pads.pad.rows": 20, "pads.pad.cols": 20})
    sim = gs.Simulator(scene)
    for _ in range(40):  # the pad sinks onto the ball
        sim.step(np.zeros(scene.nu))
    forces = gs.render(sim)
    strongest = marker_colors(np.array([1.0]))[0].astype(int)
    force = sim.tactile()[0, :, 2]
    assert force.max() > 0
    panel = forces[:, -170:]
    assert (np.ptp(panel.astype(int), axis=2) > 60).any()  # coloured, not grey
    assert strongest.sum() < 120


def test_camera_frames_the_moving_bodies_from_every_view() -> None:
    drawing = scene_drawing(gs.Simulator(gs.load_scene("insertion")))
    for name in VIEWS:
        camera = framing_camera([drawing], name)
        pixels, depth = View(camera, (200, 200), (100.0, 100.0)).project(drawing.pads[0].positions)
        assert (depth > 0).all() and (pixels > 0).all() and (pixels < 200).all()


def test_camera_frames_marks_as_well() -> None:
    """The goal of a box lies outside of the view of the box alone."""
    drawing = scene_drawing(gs.Simulator(gs.load_scene("pushing")))
    goal = Polyline(np.array([[0.4, -0.2, 0.0], [0.5, -0.2, 0.0]]), "goal")
    inside = []
    for polylines in ([], [goal]):
        camera = framing_camera([drawing], polylines=polylines)
        pixels, depth = View(camera, (200, 200), (100.0, 100.0)).project(goal.points)
        inside.append(bool((depth > 0).all() and (pixels > 0).all() and (pixels < 200).all()))
    assert inside == [False, True]


def test_marks_are_lists_of_points() -> None:
    assert Polyline([[0, 0, 0], [0, 0, 1]], "goal").points.shape == (2, 3)  # type: ignore[arg-type]
    for points in ([], np.zeros(3), [[0, 0]], [[0, 0, np.nan]]):
        with pytest.raises(UsageError, match="points of a polyline must be a list of"):
            Polyline(points, "goal")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="polylines must be a list of Polyline"):
        gs.render(gs.Simulator(gs.load_scene("pushing")), polylines=[3])  # type: ignore[list-item]


def test_film_has_one_camera_and_the_pictures_of_the_rollout() -> None:
    scene = gs.load_scene("pushing")
    controls = np.zeros((1, scene.nu))
    controls[0, scene.u("gripper_x")] = 2.0
    sim = gs.Simulator(scene)
    drawings = record_rollout(sim, controls, [0, 10, 60])
    first, _, last = film_pictures(sim, drawings, [0.0, 0.05, 0.3], size=(160, 120))
    assert first.shape == (120, 160, 3)
    assert np.abs(first.astype(int) - last).max() > 50
    again = gs.Simulator(scene)
    for _ in range(60):
        again.step(controls[0])
    assert drawings[-1].poses[0].position[0] == again.poses()[0, 0, 0]


def test_scales_are_round_and_have_units() -> None:
    assert [round_scale(value) for value in (0.0, 0.011, 0.02, 3.0, 7.0)] == [1.0, 0.02, 0.02, 5.0, 10.0]
    assert (quantity(0.02, "N"), quantity(5, "N"), quantity(1e-14, "N")) == ("20 mN", "5 N", "0 N")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera": "obliqe"}, "did you mean oblique|oblique"),
        ({"size": 640}, "size must be width and height"),
        ({"size": (10, 480)}, "width"),
        ({"env": 3}, "env must be below 1"),
    ],
)
def test_wrong_arguments_are_refused(arguments: dict[str, object], message: str) -> None:
    sim = gs.Simulator(gs.load_scene("pushing"))
    with pytest.raises(UsageError, match=message):
        gs.render(sim, **arguments)  # type: ignore[arg-type]


def test_wrong_camera_is_refused() -> None:
    with pytest.raises(UsageError, match="distance must be above 0"):
        gs.Camera((0.0, 0.0, 0.0), -1.0)


def test_picture_shows_a_shape_that_was_rotated_on_its_body() -> None:
    sim = gs.Simulator(gs.load_scene("pushing"))
    before = gs.render(sim)
    sim.param("box.shape.turn.z")[:] = 0.6
    assert (gs.render(sim) != before).sum() > 1000


def test_cameras_of_wrong_types_are_refused() -> None:
    for target in (0.1, ("a", 0, 0), (0.0, 0.0)):
        with pytest.raises(UsageError, match="camera"):
            gs.Camera(target, 1.0)  # type: ignore[arg-type]
