"""Wrong arguments of a simulator are refused by a UsageError of one line that names them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.torch_layer import TorchState, torch_rollout, torch_state

U = np.zeros((2, 2, 6))  # of "pushing"
FLOAT: Any = 0.5

CALLS: list[tuple[Callable[[Any], Any], str]] = [
    (lambda s: s.reset([[1], [1, 2]]), "which must be numeric"),
    (lambda s: s.reset(np.ones(3)), r"which must have shape \(2,\), got \(3,\)"),
    (lambda s: s.clear_history(np.ones(3)), r"which must have shape \(2,\), got \(3,\)"),
    (lambda s: s.tactile(np.zeros(3)), "out must have shape"),
    (lambda s: s.tactile(np.zeros((2, 130, 3), np.float32)), "out must be a C-contiguous array"),
    (lambda s: s.tactile(3), "tactile: arguments of these types: int"),
    (lambda s: s.poses(np.zeros(2)), "out must have shape"),
    (lambda s: s.wrenches(3), "wrenches: arguments of these types: int"),
    (lambda s: s.step(np.zeros(6), 1.5), "steps must be an integer, got 1.5"),
    (lambda s: s.step(np.zeros(5)), "u must have shape"),
    (lambda s: s.step([1, [2]]), "u must be numeric"),
    (lambda s: s.rollout("a"), "u must be numeric"),
    (lambda s: s.rollout(U, q=np.zeros(3)), r"q must have shape \(2, 7\), got \(3,\)"),
    (lambda s: s.rollout(U, v="a"), "v must be numeric"),
    (lambda s: s.rollout(U, anchors=np.zeros(77)), r"anchors must have shape \(2, 0, 3\), got \(77,\)"),
    (lambda s: s.rollout(U, read_after="a"), "read_after must be numeric"),
    (
        lambda s: s.rollout_gradient(s.rollout(U), q=np.zeros(77)),
        r"a gradient must have shape \(3, 2, 7\), got \(77,\)",
    ),
    (lambda s: s.param(3), "no parameter 3"),
    (lambda s: type(s)("pushing"), "scene must be a Scene"),
    (lambda s: type(s)(s.scene, num_envs=1.5), "num_envs must be an integer"),
    (
        lambda s: torch_rollout(s, torch_state(s), torch.from_numpy(U), params={"pad_box.mu": FLOAT}),
        "pad_box.mu must be a tensor of torch.float64, got float",
    ),
]


@pytest.mark.parametrize(("call", "message"), CALLS, ids=[message for _, message in CALLS])
def test_wrong_argument(call: Callable[[Any], Any], message: str) -> None:
    sim = Simulator(load_scene("pushing", friction="viscous"), num_envs=2)
    with pytest.raises(UsageError, match=f"^{message}") as caught:
        call(sim)
    assert "\n" not in str(caught.value)
    assert (sim.q == sim.q[0]).all()


FREE = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>
  <body><freejoint name="f"/><geom size="0.1"/></body>
  <body pos="1 0 0"><joint name="b" type="ball"/><geom size="0.1"/><site name="s"/></body>
  <body pos="2 0 0"><joint name="h"/><geom size="0.1"/></body></worldbody>
  <actuator><motor name="p" joint="h"/></actuator></mujoco>"""


@pytest.mark.parametrize(("joint", "start"), [("f", 3), ("b", 7)])
def test_quaternion_of_length_zero(joint: str, start: int, tmp_path: Path) -> None:
    (tmp_path / "free.xml").write_text(FREE)
    sim = Simulator(load_scene(tmp_path / "free.xml"), num_envs=2)
    q = sim.q.copy()
    q[1, start : start + 4] = 0
    message = rf"environment 1: the quaternion of joint '{joint}', q\[{start}:{start + 4}\], has length 0"
    with pytest.raises(UsageError, match=message):
        sim.rollout(np.zeros((1, 2, 1)), q=q)
    sim.rollout(np.zeros((1, 2, 1)), q=q, active=[True, False])
    state = torch_state(sim)
    state = TorchState(torch.from_numpy(q), state.v, state.anchors, state.anchored, state.history)
    with pytest.raises(UsageError, match=message):
        torch_rollout(sim, state, torch.zeros((1, 2, 1)).double())


@pytest.mark.parametrize(
    ("pad", "extra", "message"),
    [
        ("p", "ks = 1", "the name 'p' is used twice"),
        ("pad", 'law = "elastic"\nks = 0', "the elastic friction law needs ks > 0"),
    ],
)
def test_refusals_of_the_core_at_load(
    pad: str, extra: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "free.xml").write_text(FREE)
    law = "kn = 1\nkt = 1\nmu = 1\nkd = 1"
    table = f'[pads.{pad}]\nsite = "s"\nrows = 2\ncols = 2\npitch = 1e-3\nagainst = "floor"\n{law}\n'
    (tmp_path / "s.toml").write_text(f'format = 1\nmodel = "free.xml"\nstep = 0.002\n{table}{extra}\n')
    with pytest.raises(UsageError, match=message):
        load_scene(tmp_path / "s.toml").build()
    assert main(["describe", str(tmp_path / "s.toml"), "--no-timing"]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
