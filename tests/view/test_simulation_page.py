"""The page of a simulator without a browser: loops of one's own, buttons, sliders, descriptions."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gelflow.sim as gs
import gelflow.view
from gelflow.errors import UsageError
from gelflow.view import simulation_page
from gelflow.view.body_text import body_text
from gelflow.view.joint_sliders import Sliders, control_ranges, coordinates, read_coordinate, write_coordinate
from gelflow.view.page import Page
from gelflow.view.simulation_page import SimulationPage

MJCF = """<mujoco><compiler angle="radian"/><worldbody><body name="arm">
<joint name="turn" type="hinge" axis="0 0 1" range="-1 1"/>
<geom type="capsule" size="0.01 0.05"/></body><body name="loose" pos="0 0 0.3"><freejoint name="free"/>
<geom type="ellipsoid" size="0.01 0.02 0.03"/></body></worldbody></mujoco>"""


def test_a_loop_of_ones_own_shows_the_latest_state() -> None:
    scene = gs.load_scene("pushing")
    sim = gs.Simulator(scene, num_envs=2)
    with gelflow.view.open(sim, env=1, port=0) as viewer:
        controls = np.zeros(scene.nu)
        controls[scene.u("gripper_x")] = 2.0
        for _ in range(60):
            sim.step(controls)
        viewer._next = 0.0  # as if the last update were long ago
        assert viewer.update()
        assert not viewer.update()  # a moment later nothing is drawn
        for node, pose in zip(viewer._view._bodies, sim.poses()[1], strict=True):
            np.testing.assert_allclose(node.position, pose[:3])
        assert "environment 1 of 2" in viewer._status.content
        viewer._post(viewer._choose_env, 0)
        viewer._handle_events()
        assert viewer.env == 0


def test_updates_take_a_bounded_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a clock of the test: a step takes 1 ms, a picture 50 ms, later 1 ms."""
    now, cost = 1000.0, 0.0

    def show(_: object) -> None:
        nonlocal now
        now += cost

    sim = gs.Simulator(gs.load_scene("insertion"))
    with gelflow.view.open(sim, port=0) as viewer:
        viewer._page.watched = lambda: True  # type: ignore[method-assign]
        monkeypatch.setattr(simulation_page, "time", SimpleNamespace(perf_counter=lambda: now))
        monkeypatch.setattr(viewer, "_show", show)
        for seconds, most in ((0.05, simulation_page.MAX_SHARE / 0.05), (0.001, simulation_page.MAX_RATE)):
            cost, shown, start = seconds, 0, now
            while now - start < 10.0:
                now += 0.001
                shown += viewer.update()
            assert 0.8 * most < shown / 10.0 < 1.1 * most


def test_steps_and_sliders_act_on_the_environment() -> None:
    scene = gs.load_scene("rolling", overrides={"pads.pad.rows": 10, "pads.pad.cols": 10})
    sim = gs.Simulator(scene, num_envs=2)
    with SimulationPage(sim, env=1, port=0, controls=True) as page:
        page._post(page._single_step)
        page.run(until=lambda: page._steps >= 1)
        assert page._steps == 1 and not page.playing
        index = [c.label for c in page._coordinates].index("pad_x [m]")
        page._post(page._move, index, 0.01)
        page._handle_events()
        assert sim.q[1, sim.joint_q("pad_x")] == 0.01 and sim.q[0, sim.joint_q("pad_x")] != 0.01
        page._post(page._control, scene.u("pad_x"), 0.5)
        page._post(page._set_playing, True)
        page.run(until=lambda: page._steps >= 20)
        assert sim.q[1, sim.joint_q("pad_x")] > 0.01
        page._post(page._reset)
        page._handle_events()
        np.testing.assert_array_equal(sim.q[1], scene.q0)


def test_a_failed_step_pauses_and_is_named() -> None:
    scene = gs.load_scene("pushing")
    sim = gs.Simulator(scene)
    with SimulationPage(sim, port=0, controls=True) as page:
        sim.status[0] = 1
        page._set_playing(True)
        page._step()
        page._next = 0.0
        page.update()
        assert not page.playing
        assert gs.STATUS_MESSAGES[1] in page._status.content


def test_every_joint_of_a_model_file_has_sliders(tmp_path: Path) -> None:
    path = tmp_path / "two.xml"
    path.write_text(MJCF)
    scene = gs.load_scene(path)
    sim = gs.Simulator(scene)
    found = coordinates(scene)
    assert len(found) == 1 + 6
    assert (found[0].low, found[0].high) == (-1.0, 1.0)
    for number, value in ((0, 0.5), (1, 0.02), (4, 0.3), (6, -0.7)):
        write_coordinate(sim, 0, found[number], value)
    assert [read_coordinate(sim, 0, c) for c in found] == pytest.approx([0.5, 0.02, 0.0, 0.3, 0.3, 0.0, -0.7], abs=1e-9)
    turn = Rotation.from_quat(sim.q[0, 4:8], scalar_first=True).as_rotvec()
    np.testing.assert_allclose(turn, [0.3, 0.0, -0.7], atol=1e-9)
    with SimulationPage(sim, port=0, controls=True) as page:
        page._single_step()


@pytest.mark.parametrize("name", gs.scene_names())
def test_every_scene_has_a_page_and_descriptions(name: str) -> None:
    scene = gs.load_scene(name)
    sim = gs.Simulator(scene)
    assert len(control_ranges(scene)) == scene.nu
    for start, low, high in control_ranges(scene):
        assert low <= start <= high and low < high
    description = gs.describe(scene)
    for body in scene.bodies:
        assert body.name.replace("_", "\\_") in body_text(description, body.name)
    with SimulationPage(sim, port=0, controls=True) as page:
        page._describe(0)
        assert f"{description.bodies[1].mass:.4g} kg" in page._body.content
        page._single_step()
        page._next = 0.0
        assert page.update()


def test_wrong_arguments_are_refused() -> None:
    sim = gs.Simulator(gs.load_scene("pushing"))
    with pytest.raises(UsageError, match="env must be below 1"):
        gelflow.view.open(sim, env=3, port=0)
    with pytest.raises(UsageError, match="a Simulator"):
        gelflow.view.open("pushing", port=0)  # type: ignore[arg-type]


def test_a_slider_shows_a_value_at_its_upper_end() -> None:
    low, high = -1.43, 1.75
    assert low + (high - low) / 500 * 500 < high  # the end of the slider is rounded
    page = Page(port=0)
    try:
        sliders = Sliders(page.gui, "joints", [("joint", high, low, high)], lambda number, value: None, expanded=True)
        sliders.show([low])
        sliders.show([high])
        (handle,) = sliders._handles
        assert handle.value == pytest.approx(high) and handle.value <= handle.max
    finally:
        page.close()


def test_bodies_whose_names_contain_slashes_are_drawn_in_the_world(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(MJCF.replace('name="arm"', 'name="robot"').replace('name="loose"', 'name="robot/hand"'))
    with SimulationPage(gs.Simulator(gs.load_scene(path)), port=0, controls=True) as page:
        names = [node.name for node in page._view._bodies]
    assert len(set(names)) == 2 and {name.rpartition("/")[0] for name in names} == {"/scene/bodies"}
