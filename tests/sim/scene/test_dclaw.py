"""The dclaw scene: what is in it, fingers that close on the cap and turn it."""

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.sim.scene import FRICTION_LAWS, Scene, load_scene
from gelflow.sim.simulator import Simulator


def controls(scene: Scene, joint: str, change: float) -> np.ndarray:
    """A change of one kind of joint's targets, in all fingers alike."""
    u = np.zeros(scene.nu)
    u[[scene.u(f"{joint}{finger}") for finger in (1, 2, 3)]] = change
    return u


def closed(sim: Simulator, scene: Scene) -> np.ndarray:
    """Close the fingers on the cap; the controls that hold them there."""
    sim.q[:] = scene.q0
    u = scene.q0[: scene.nu].copy()
    for _ in range(40):
        u += controls(scene, "bend", 0.1 / 40)
        sim.step(u)
    return u


def pressures(sim: Simulator, scene: Scene) -> np.ndarray:
    """Sum of the normal forces that each fingertip's markers feel [N]."""
    return np.array([sim.tactile()[0, scene.marker_slice(f"tip{i}"), 2].sum() for i in (1, 2, 3)])


def test_the_hand_is_as_published() -> None:
    scene = load_scene("dclaw")
    assert (scene.nq, scene.nu, scene.num_markers) == (10, 9, 3 * 302)
    assert [a.name for a in scene.actuators] == [j.name for j in scene.joints[:9]]
    cap = next(shape for shape in scene.shapes if shape.name == "cap")
    assert cap.kind == "cylinder" and 2 * cap.size[1] == pytest.approx(0.03)
    for points in scene.points:
        assert points.weights.sum() == pytest.approx(2 * np.pi * 0.01**2)
    sim = Simulator(scene)
    for name in ("cap.pos.x", "cap.pos.y", "cap.size.x", "cap.damping"):  # drawn at random per episode
        assert sim.param(name).shape == (1,)


def test_it_is_the_same_from_three_sides() -> None:
    """The hand turned by a third of a turn is the hand."""
    scene = load_scene("dclaw")
    sim = Simulator(scene)
    sim.q[:] = scene.q0
    tips = sim.poses()[0, [scene.body(f"tip{i}") for i in (1, 2, 3)], :3]
    third = 2 * np.pi / 3
    turn = np.array([[np.cos(third), -np.sin(third), 0], [np.sin(third), np.cos(third), 0], [0, 0, 1]])
    np.testing.assert_allclose(tips[1], turn @ tips[0], atol=1e-12)
    np.testing.assert_allclose(tips[2], turn @ tips[1], atol=1e-12)


@pytest.mark.parametrize("distance", [0.01, 0.03, 0.06, 0.09, 0.11])
def test_the_tips_reach_every_cap(distance: float) -> None:
    """Two links of 80 mm from the knuckle to a tip this far from the hand's middle, half way up the cap."""
    scene = load_scene("dclaw")
    sim = Simulator(scene)
    sim.q[:] = scene.q0
    out, down = distance - 0.07, 0.165 - 0.035
    curl = np.arccos((out**2 + down**2) / (2 * 0.08**2) - 1)
    bend = -np.arctan2(out, down) - curl / 2
    for joint, value in (("bend1", bend), ("curl1", curl)):
        low, high = next(j.range for j in scene.joints if j.name == joint) or (0, 0)
        assert low < value < high
        sim.q[0, scene.q(joint)] = value
    pose = sim.poses()[0, scene.body("tip1")]
    turned = bend + curl  # about y
    tip = pose[:3] - 0.08 * np.array([np.sin(turned), 0, np.cos(turned)])
    np.testing.assert_allclose(tip, [distance, 0, 0.035], atol=1e-12)
    assert 0 < turned < 1.2  # the markers' half of the tip looks at the cap


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_the_fingers_close_and_turn_the_cap(law: str) -> None:
    scene = load_scene("dclaw", friction=law)
    sim = Simulator(scene)
    u = closed(sim, scene)
    assert sim.q[0, 9] == pytest.approx(0, abs=1e-4)  # pressed from three sides alike it does not turn
    pressed = pressures(sim, scene)
    assert (pressed > 0.2).all() and pressed == pytest.approx(pressed.mean(), rel=0.05)
    for _ in range(60):
        u += controls(scene, "swing", 0.15 / 60)
        sim.step(u)
    sim.check()
    assert (pressures(sim, scene) > 0.05).all()
    assert sim.q[0, scene.q("cap")][0] > 0.15


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_one_joint_turns_the_cap_either_way(law: str) -> None:
    scene = load_scene("dclaw", friction=law)
    angles = []
    for change in (-0.1, 0.1):
        sim = Simulator(scene)
        u = closed(sim, scene)
        u[scene.u("swing2")] += change
        sim.step(u, 60)
        sim.check()
        angles.append(sim.q[0, scene.q("cap")][0])
    assert angles[0] < -0.02 and angles[1] > 0.02


def test_where_the_cap_is_touched_the_markers_x_runs_to_the_tip() -> None:
    """The marker nearest to the cap's axis looks at the cap, and its x runs along the finger."""
    scene = load_scene("dclaw")
    sim = Simulator(scene)
    sim.q[:] = scene.q0
    for i in (1, 2, 3):
        pad, pose = scene.pads[i - 1], sim.poses()[0, scene.body(f"tip{i}")]
        w, x, y, z = pose[3:]
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        axes, places = turn @ pad.axes, pose[:3] + pad.positions @ turn.T
        nearest = int(np.linalg.norm(places[:, :2], axis=1).argmin())
        towards = -places[nearest] * [1, 1, 0]
        assert axes[nearest, :, 2] @ towards / np.linalg.norm(towards) > 0.98
        assert axes[nearest, :, 0] @ (turn @ [0, 0, -1]) > 0.5


def test_it_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "dclaw", "--no-timing"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "dclaw: steps of 5 ms, elastic law" in text
    assert "tip1: 302 markers, a hemisphere, on tip1 against cap" in text
    assert "cylinder cap" in text
