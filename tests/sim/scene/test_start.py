"""The start of a scene: its positions, and the controls of the keyframe or those that hold the servos."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from gelflow.sim.scene import load_scene
from gelflow.sim.scene.start_controls import holding_controls, start_controls
from gelflow.sim.simulator import Simulator

_SERVO = """<mujoco>
  <worldbody>
    <body><joint name="slide" type="slide"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><position name="servo" joint="slide"/><motor name="motor" joint="slide"/></actuator>
  <keyframe><key name="home" qpos="0.3"{}/></keyframe>
</mujoco>"""


def test_start_controls_are_those_of_the_keyframe(tmp_path: Path) -> None:
    path = tmp_path / "servo.xml"
    path.write_text(_SERVO.format(' ctrl="0.2 4"'), encoding="utf-8")
    scene = load_scene(path)
    np.testing.assert_array_equal(start_controls(scene), [0.2, 4.0])
    np.testing.assert_array_equal(holding_controls(scene), [0.3, 0.0])
    path.write_text(_SERVO.format(""), encoding="utf-8")
    np.testing.assert_array_equal(start_controls(load_scene(path)), [0.3, 0.0])


def test_fingers_of_the_insertion_hold_the_part_at_the_start() -> None:
    scene = load_scene("insertion")
    sim = Simulator(scene)
    sim.clear_history()
    sim.step(start_controls(scene), 200)
    part = sim.q[0, scene.q("part")]
    np.testing.assert_allclose(part[:3], scene.q0[scene.q("part")][:3], atol=0.5e-3)


@pytest.mark.parametrize("precision", ["double", "single"])
def test_a_simulator_starts_at_the_scenes_start_and_returns_there(precision: Literal["double", "single"]) -> None:
    insertion = load_scene("insertion")
    sim = Simulator(insertion, num_envs=3, precision=precision)
    start = sim.q.copy()
    np.testing.assert_array_equal(start, np.tile(insertion.q0, (3, 1)).astype(sim.dtype))
    sim.step(holding_controls(insertion))
    moved = sim.q.copy()
    sim.reset([True, False, True])
    np.testing.assert_array_equal(sim.q[[0, 2]], start[[0, 2]])
    np.testing.assert_array_equal(sim.q[1], moved[1])
    assert (moved != start).any(1).all()
    assert (Simulator(insertion.build()).q != insertion.q0).any()  # a core model has its reference configuration only
