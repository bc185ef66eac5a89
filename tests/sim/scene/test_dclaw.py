"""The dclaw scene: geometry, reachability, and fingers that close on the cap and turn it."""

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.sim.scene import FRICTION_LAWS, Scene, load_scene
from gelflow.sim.simulator import Simulator


def controls(scene: Scene, joint: str, change: float) -> np.ndarray:
    """The change of controls that moves the targets of one joint by `change` in all fingers."""
    u = np.zeros(scene.nu)
    u[[scene.u(f"{joint}{finger}") for finger in (1, 2, 3)]] = change
    return u


def closed(sim: Simulator, scene: Scene) -> np.ndarray:
    """Close the fingers on the cap; returns the controls that hold them closed."""
    sim.q[:] = scene.q0
    u = scene.q0[: scene.nu].copy()
    for _ in range(40):
        u += controls(scene, "bend", 0.1 / 40)
        sim.step(u)
    return u


def normal_forces(sim: Simulator, scene: Scene) -> np.ndarray:
    """Sum of the normal tactile forces of each fingertip [N], shape (3,)."""
    return np.array([sim.tactile()[0, scene.marker_slice(f"tip{i}"), 2].sum() for i in (1, 2, 3)])


def test_hand_matches_the_publication() -> None:
    scene = load_scene("dclaw")
    assert (scene.nq, scene.nu, scene.num_markers) == (10, 9, 3 * 302)
    assert [a.name for a in scene.actuators] == [j.name for j in scene.joints[:9]]
    cap = next(shape for shape in scene.shapes if shape.name == "cap")
    assert cap.kind == "cylinder" and 2 * cap.size[1] == pytest.approx(0.03)
    for points in scene.points:
        assert points.weights.sum() == pytest.approx(2 * np.pi * 0.01**2)
    sim = Simulator(scene)
    for name in ("cap.pos.x", "cap.pos.y", "cap.size.x", "cap.damping"):  # randomized per episode
        assert sim.param(name).shape == (1,)


def test_hand_has_threefold_symmetry() -> None:
    """A rotation by 120° maps each finger to the next one."""
    scene = load_scene("dclaw")
    sim = Simulator(scene)
    tips = sim.poses()[0, [scene.body(f"tip{i}") for i in (1, 2, 3)], :3]
    third = 2 * np.pi / 3
    rotation = np.array([[np.cos(third), -np.sin(third), 0], [np.sin(third), np.cos(third), 0], [0, 0, 1]])
    np.testing.assert_allclose(tips[1], rotation @ tips[0], atol=1e-12)
    np.testing.assert_allclose(tips[2], rotation @ tips[1], atol=1e-12)


@pytest.mark.parametrize("distance", [0.01, 0.03, 0.06, 0.09, 0.11])
def test_tips_reach_caps_of_all_sizes(distance: float) -> None:
    """Inverse kinematics of two links of 80 mm to a tip at this distance from the centre, at half the cap height."""
    scene = load_scene("dclaw")
    sim = Simulator(scene)
    out, down = distance - 0.07, 0.165 - 0.035
    curl = np.arccos((out**2 + down**2) / (2 * 0.08**2) - 1)
    bend = -np.arctan2(out, down) - curl / 2
    for joint, value in (("bend1", bend), ("curl1", curl)):
        low, high = next(j.range for j in scene.joints if j.name == joint) or (0, 0)
        assert low < value < high
        sim.q[0, scene.q(joint)] = value
    pose = sim.poses()[0, scene.body("tip1")]
    tilt = bend + curl  # about y
    tip = pose[:3] - 0.08 * np.array([np.sin(tilt), 0, np.cos(tilt)])
    np.testing.assert_allclose(tip, [distance, 0, 0.035], atol=1e-12)
    assert 0 < tilt < 1.2  # the half of the tip with markers faces the cap


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_fingers_close_and_turn_the_cap(law: str) -> None:
    scene = load_scene("dclaw", friction=law)
    sim = Simulator(scene)
    u = closed(sim, scene)
    assert sim.q[0, 9] == pytest.approx(0, abs=1e-4)  # symmetric contact forces do not turn the cap
    pressure = normal_forces(sim, scene)
    assert (pressure > 0.2).all() and pressure == pytest.approx(pressure.mean(), rel=0.05)
    for _ in range(60):
        u += controls(scene, "swing", 0.15 / 60)
        sim.step(u)
    sim.check()
    assert (normal_forces(sim, scene) > 0.05).all()
    assert sim.q[0, scene.q("cap")][0] > 0.15


@pytest.mark.parametrize("law", FRICTION_LAWS)
def test_one_finger_turns_the_cap_both_ways(law: str) -> None:
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


def test_marker_x_axes_point_to_the_tip_at_the_cap() -> None:
    """At the marker nearest to the cap axis, z faces the axis and x points along the finger to the tip."""
    scene = load_scene("dclaw")
    sim = Simulator(scene)
    for i in (1, 2, 3):
        pad, pose = scene.pads[i - 1], sim.poses()[0, scene.body(f"tip{i}")]
        w, x, y, z = pose[3:]
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        axes, positions = rotation @ pad.axes, pose[:3] + pad.positions @ rotation.T
        nearest = int(np.linalg.norm(positions[:, :2], axis=1).argmin())
        to_axis = -positions[nearest] * [1, 1, 0]
        assert axes[nearest, :, 2] @ to_axis / np.linalg.norm(to_axis) > 0.98
        assert axes[nearest, :, 0] @ (rotation @ [0, 0, -1]) > 0.5


def test_describe_shows_the_scene(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "dclaw", "--no-timing"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "dclaw: steps of 5 ms, elastic law" in text
    assert "tip1: 302 markers, a hemisphere, on tip1 against cap" in text
    assert "cylinder cap" in text
