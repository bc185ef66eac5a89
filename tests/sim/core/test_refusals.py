"""Wrong arguments of a simulator are refused by a UsageError of one line that names them."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.drawing.renderer import render
from gelflow.sim.drawing.scene_drawing import Polyline
from gelflow.sim.reductions import TactileReduction, center_of_pressure, pad_forces
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.insertion import insertion_scene
from gelflow.sim.tasks.randomization import Randomization
from gelflow.sim.tasks.registry import make_task
from gelflow.sim.torch_layer import TorchState, torch_rollout, torch_site_poses, torch_state
from gelflow.sim.trajectory import TouchStop
from gelflow.sim.validation.energy import EnergyGauge

U = np.zeros((2, 2, 6))  # of "pushing"
FLOAT: Any = 0.5

CALLS: list[tuple[Callable[[Any], Any], str]] = [
    (lambda s: s.reset([[1], [1, 2]]), "which must be numeric"),
    (lambda s: s.reset(np.ones(3)), r"which must have shape \(2,\), got \(3,\)"),
    (lambda s: s.reset([0, 2]), "which must be a mask of True and False, got 2"),
    (lambda s: s.clear_history(np.ones(3)), r"which must have shape \(2,\), got \(3,\)"),
    (lambda s: s.tactile(np.zeros(3)), "out must have shape"),
    (lambda s: s.tactile(np.zeros((2, 130, 3), np.float32)), "out must be a C-contiguous array"),
    (lambda s: s.tactile(3), "tactile: arguments of these types: int"),
    (lambda s: s.poses(np.zeros(2)), "out must have shape"),
    (lambda s: s.wrenches(3), "wrenches: arguments of these types: int"),
    (lambda s: s.step(np.zeros(6), 1.5), "steps must be an integer, got 1.5"),
    (lambda s: s.step(np.zeros(6), -1), "steps must not be negative, got -1"),
    (lambda s: s.step(np.zeros(6), 2**31), "steps must be at most 2147483647, got 2147483648"),
    (lambda s: s.rollout(U, read_after=np.array([2**32 + 2])), "read_after must be at most 2147483647, got 4294967298"),
    (lambda s: type(s)(s.scene, num_envs=2**31), "num_envs must be at most"),
    (lambda s: TactileReduction(np.zeros((1, 130, 3)), 5), "names must be the names of the rows, got 5"),  # type: ignore[arg-type]
    (lambda s: replace(s.scene, gravity=np.zeros(2)).build(), ".*a value has a wrong type or shape"),
    (lambda s: render(s, title=5), "title must be a string, got 5"),  # type: ignore[arg-type]
    (lambda s: Polyline(np.zeros((2, 3)), 5), "the label of a polyline must be a string, got 5"),  # type: ignore[arg-type]
    (
        lambda s: torch_rollout(s, torch_state(s), torch.from_numpy(U).to_sparse()),
        "u must be a CPU tensor of torch.float64, got sparse torch.float64",
    ),
    (lambda s: s.step(np.zeros(5)), "u must have shape"),
    (lambda s: s.site_poses("a"), "q must be numeric"),
    (lambda s: s.marker_slice(np.zeros(2)), r"no pad ndarray of shape \(2,\)"),
    (lambda s: s.joint_q(3), "no joint 3"),
    (lambda s: s.contact_modes(None), "trajectory must be a Trajectory, got None"),
    (lambda s: s.rollout_gradient(None), "trajectory must be a Trajectory, got None"),
    (lambda s: s.tactile(reduction=3), "reduction must be a TactileReduction, got 3"),
    (lambda s: s.rollout(U, stop=1.0), "stop must be a TouchStop, got 1.0"),
    (lambda s: s.rollout(U, stop=TouchStop("a")), "threshold must be numeric"),
    (lambda s: s.rollout(U, read_after=3), "read_after must be a sequence of integers, got 3"),
    (lambda s: s.rollout(U, anchored=-1), "anchored must be numeric"),
    (lambda s: s.rollout(U + 1j), "u must be real, got complex128"),
    (
        lambda s: torch_rollout(s, replace(torch_state(s), anchored=torch.zeros(1)), torch.from_numpy(U)),
        "state.anchored must be a CPU tensor of torch.uint8, got torch.float32",
    ),
    (
        lambda s: torch_site_poses(s, torch.zeros((2, s.model.nq), dtype=torch.int64)),
        "q must be a CPU tensor of torch.float32 or torch.float64, got torch.int64",
    ),
    (lambda s: s.scene.q(3), "no joint 3"),
    (lambda s: load_scene(3), "scene must be a name or a path, got int"),  # type: ignore[arg-type]
    (lambda s: load_scene("pushing", preset=[1]), r".*no preset \[1\]"),  # type: ignore[arg-type]
    (lambda s: make_task("pushing", "a"), "num_envs must be an integer, got 'a'"),  # type: ignore[arg-type]
    (lambda s: pad_forces(3), "scene must be a Scene"),  # type: ignore[arg-type]
    (lambda s: center_of_pressure(3, 3), "force must be an array or a tensor of shape"),
    (lambda s: center_of_pressure(np.ones((2, 2)), np.ones((2, 3))), r"force must be .* got ndarray of shape \(2, 2\)"),
    (
        lambda s: center_of_pressure(np.ones((2, 3)), np.ones((4, 3))),
        "force and moment must have the same type and shape",
    ),
    (lambda s: EnergyGauge(3), "scene must be a Scene"),  # type: ignore[arg-type]
    (lambda s: EnergyGauge(s.scene).read(3), "sim must be a Simulator, got 3"),  # type: ignore[arg-type]
    (lambda s: EnergyGauge(s.scene).read(s), "num_envs is 1 of the gauge and 2 of the simulator"),
    (lambda s: EnergyGauge(load_scene("rolling"), num_envs=2).read(s), "the simulator must be one of the scene"),
    (lambda s: Simulator(load_scene("insertion")).displacement("a"), "forces must be numeric"),
    (lambda s: insertion_scene(3), "task must be an InsertionTask, got 3"),  # type: ignore[arg-type]
    (lambda s: Randomization(3), "quantities must be a mapping of names to quantities, got 3"),  # type: ignore[arg-type]
    (lambda s: Randomization({"mass": 3}), "quantity 'mass' must be a Quantity, got 3"),  # type: ignore[dict-item]
    (lambda s: torch_state(3), "sim must be a Simulator, got 3"),  # type: ignore[arg-type]
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
    (lambda s: s.rollout(U, read_after=[0.5]), r"read_after must be a sequence of integers, got \[0.5\]"),
    (
        lambda s: torch_rollout(s, torch_state(s), torch.from_numpy(U), read_after=(FLOAT,)),
        "read_after must be a sequence of integers",
    ),
    (lambda s: torch_rollout(s, replace(torch_state(s), anchored=FLOAT), torch.from_numpy(U)), "state.anchored must"),
    (lambda s: setattr(s, "q", s.q + 1), "q is a view of the simulator's state; write its elements: sim.q"),
    (lambda s: type(s)(s.scene, precision=np.float32), "precision must be 'double' or 'single', got <class"),
    (lambda s: type(s)(replace(s.scene, q0=np.zeros(3))), r"q0 of the scene must have shape \(7,\), got \(3,\)"),
    (lambda s: replace(s.scene, points=()).build(), ".*a contact or pad refers to 'pad', which the scene lacks"),
    (lambda s: load_scene("pushing", overrides={3: 1}), "overrides must have dotted keys"),  # type: ignore[dict-item]
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
    present = sim.q.copy()
    sim.q[:] = q
    with pytest.raises(UsageError, match=message):
        sim.step(np.zeros(1))
    sim.step(np.zeros(1), active=[True, False])
    with pytest.raises(UsageError, match=message):
        sim.error_estimate(np.zeros(1))
    sim.q[:] = present
    state = torch_state(sim)
    state = TorchState(torch.from_numpy(q), state.v, state.anchors, state.anchored, state.history)
    with pytest.raises(UsageError, match=message):
        torch_rollout(sim, state, torch.zeros((1, 2, 1)).double())


@pytest.mark.parametrize(
    ("pad", "extra", "message"),
    [
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


WRONG_PARAMETERS = [
    ("box.mass", -1.0, "parameter 'box.mass' must be positive, got -1"),
    ("box.mass", 0.0, "parameter 'box.mass' must be positive, got 0"),
    ("box.inertia.xx", -1e-9, "parameter 'box.inertia.xx' must not be negative, got -1e-09"),
    ("box.inertia.xy", 1.0, "the inertia of body 'box' must have no negative principal moment"),
    ("box.inertia.zz", 1.0, "the inertia of body 'box' must have no principal moment above the sum of the others"),
    ("box.mass", np.nan, "parameter 'box.mass' must be a number, got nan"),
    ("box.mass", np.inf, "parameter 'box.mass' must be finite, got inf"),
    ("box.com.x", np.nan, "parameter 'box.com.x' must be a number, got nan"),
    ("pad_box.mu", np.nan, "parameter 'pad_box.mu' must be a number, got nan"),
    ("pad_box.kn", -5.0, "parameter 'pad_box.kn' must not be negative, got -5"),
    ("pad_box.mu", -0.1, "parameter 'pad_box.mu' must not be negative, got -0.1"),
    ("box_yaw.damping", -0.1, "parameter 'box_yaw.damping' must not be negative, got -0.1"),
    ("box.points.scale.y", 0.0, "parameter 'box.points.scale.y' must be positive, got 0"),
    ("box.size.x", -0.1, "parameter 'box.size.x' must be positive, got -0.1"),
]


@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize(("name", "value", "message"), WRONG_PARAMETERS)
def test_wrong_parameter(name: str, value: float, message: str, precision: Any) -> None:
    sim = Simulator(load_scene("pushing"), num_envs=2, precision=precision)
    right = sim.param(name)[1].copy()
    sim.step(np.zeros(6))
    sim.param(name)[1] = value
    match = f"^environment 1: {message}"
    with pytest.raises(UsageError, match=match):
        sim.step(np.zeros(6))
    with pytest.raises(UsageError, match=match):
        sim.rollout(U)
    sim.step(np.zeros(6), active=[True, False])
    sim.param(name)[1] = right
    sim.step(np.zeros(6))
    values = torch.tensor([float(right), value], dtype=torch_state(sim).q.dtype)
    with pytest.raises(UsageError, match=match if np.isfinite(value) else f"^{name} is not finite"):
        torch_rollout(sim, torch_state(sim), torch.zeros((2, 2, 6), dtype=values.dtype), params={name: values})


def test_interchanged_limits_of_a_joint_are_refused() -> None:
    sim = Simulator(load_scene("pushing"))
    sim.param("box_yaw.lower")[:], sim.param("box_yaw.upper")[:] = 1.0, -1.0
    with pytest.raises(UsageError, match=r"parameter 'box_yaw\.lower' must be at most the upper limit, got 1"):
        sim.step(np.zeros(6))


@pytest.mark.parametrize("precision", ["double", "single"])
def test_memory_of_the_state_that_is_not_finite(precision: Any) -> None:
    sim = Simulator(
        load_scene("pushing", friction="elastic", overrides={"integrator": "bdf2"}), num_envs=2, precision=precision
    )
    anchors, history = np.zeros_like(sim.anchors), np.zeros_like(sim.history)
    anchors[1, 3, 0], history[1, 2] = np.nan, np.inf
    anchored = np.ones_like(sim.anchored)
    with pytest.raises(UsageError, match=r"^anchors\[1, 3\] is not finite"):
        sim.rollout(U, anchors=anchors, anchored=anchored)
    sim.rollout(U, anchors=anchors)  # none of them is set
    with pytest.raises(UsageError, match=r"^history\[1, 2\] is not finite"):
        sim.rollout(U, history=history)
    sim.history[:] = history
    with pytest.raises(UsageError, match=r"^history\[1, 2\] is not finite"):
        sim.step(np.zeros(6))
    sim.step(np.zeros(6), active=[True, False])


@pytest.mark.parametrize("read", ["tactile", "wrenches", "contact_forces", "poses", "mass_matrix", "bias"])
def test_readings_of_a_wrong_state_are_refused(read: str) -> None:
    """No force where a comparison with NaN is false, and no NaN."""
    sim = Simulator(load_scene("pushing"), num_envs=2)
    getattr(sim, read)()
    before = sim.q[1, 0]
    sim.q[1, 0] = np.nan
    with pytest.raises(UsageError, match=r"^q\[1, 0\] is not finite"):
        getattr(sim, read)()
    sim.q[1, 0] = before
    sim.param("pad_box.kn")[0] = np.nan
    with pytest.raises(UsageError, match=r"^environment 0: parameter 'pad_box\.kn' must be a number"):
        getattr(sim, read)()


NOT_FINITE = [
    ("joints", {"damping": np.nan}, "parameter 'gripper_yaw.damping' must be a number, got nan"),
    ("joints", {"stiffness": np.inf}, "parameter 'gripper_yaw.stiffness' must be finite, got inf"),
    ("joints", {"ref": np.nan}, "joint 'gripper_yaw': ref must be finite"),
    ("joints", {"pos": np.array([0, np.nan, 0])}, "joint 'gripper_yaw': pos has an entry that is not finite"),
    ("joints", {"axis": np.array([np.inf, 0, 0])}, "joint 'gripper_yaw': axis has an entry that is not finite"),
    ("actuators", {"kp": np.nan}, "parameter 'gripper_x.kp' must be a number, got nan"),
    ("pads", {"positions": np.full((130, 3), np.nan)}, "pad 'pad': position has an entry that is not finite"),
    ("pads", {"axes": np.full((130, 3, 3), np.inf)}, "pad 'pad': axes has an entry that is not finite"),
    (
        "points",
        {"areas": np.full((66, 3), np.nan), "per_area": True},
        "points 'pad': area has an entry that is not finite",
    ),
]


@pytest.mark.parametrize(("kind", "values", "message"), NOT_FINITE)
def test_a_number_of_an_element_that_is_not_finite(kind: str, values: dict[str, Any], message: str) -> None:
    scene = load_scene("pushing", friction="viscous")
    first, *others = getattr(scene, kind)
    changes: dict[str, Any] = {kind: (replace(first, **values), *others)}
    with pytest.raises(UsageError, match=re.escape(message)):
        replace(scene, **changes).build()


def test_gravity_that_is_not_finite() -> None:
    with pytest.raises(UsageError, match=re.escape("parameter 'gravity.z' must be a number, got nan")):
        replace(load_scene("pushing"), gravity=np.array([0, 0, np.nan])).build()


def test_a_pad_may_have_the_name_of_an_actuator(tmp_path: Path) -> None:
    (tmp_path / "free.xml").write_text(FREE)
    law = "kn = 1\nkt = 1\nmu = 1\nkd = 1\nks = 1"
    table = f'[pads.p]\nsite = "s"\nrows = 2\ncols = 2\npitch = 1e-3\nagainst = "floor"\n{law}\n'
    (tmp_path / "s.toml").write_text(f'format = 1\nmodel = "free.xml"\nstep = 0.002\n{table}\n')
    sim = Simulator(load_scene(tmp_path / "s.toml"))
    assert sim.param("pad:p.kd")[0] == 1 and sim.param("actuator:p.kd")[0] == 0
    assert sim.param("p.kn")[0] == 1 and sim.param("p.gear")[0] == 1
    with pytest.raises(UsageError, match=r"no parameter 'p.kd'; there are .*actuator:p.kd") as caught:
        sim.param("p.kd")
    assert "pad:p.kd" in str(caught.value)


def test_two_elements_of_one_kind_and_name_are_refused() -> None:
    spec = _core.ModelSpec()
    spec.add_shape(_core.ShapeDef(name="floor", kind="plane"))
    with pytest.raises(ValueError, match="the name 'floor' is used twice"):
        spec.add_shape(_core.ShapeDef(name="floor", kind="plane"))


def test_parameters_that_a_scene_file_cannot_have_are_refused() -> None:
    sim = Simulator(load_scene("pushing"), num_envs=2)
    sim.param("gripper_x.force_lower")[1] = 1.0
    sim.param("gripper_x.force_upper")[1] = -1.0
    with pytest.raises(UsageError, match=r"environment 1: parameter 'gripper_x.force_lower' must be at most the upper"):
        sim.step(np.zeros(sim.model.nu))


def test_a_rounding_as_large_as_the_shape_is_refused() -> None:
    scene = load_scene("pushing")
    shapes = tuple(replace(shape, rounding=0.004) if shape.name == "box" else shape for shape in scene.shapes)
    sim = Simulator(replace(scene, shapes=shapes))
    sim.step(np.zeros(sim.model.nu))
    sim.param("box.rounding")[:] = 0.025
    with pytest.raises(UsageError, match=r"parameter 'box.rounding' must be below the smallest half size, got 0.025"):
        sim.step(np.zeros(sim.model.nu))
    sim.param("box.rounding")[:] = 0.004
    sim.param("box.size.x")[:] = 0.003
    with pytest.raises(UsageError, match=r"parameter 'box.rounding' must be below the smallest half size, got 0.004"):
        sim.step(np.zeros(sim.model.nu))


def test_results_that_are_not_finite_are_refused() -> None:
    sim = Simulator(load_scene("pushing"), num_envs=2, precision="single")
    sim.v[1] = 1e30
    with pytest.raises(UsageError, match=r"result of bias: c\[1, \d+\] is not finite"):
        sim.bias()


def test_read_only_trajectories_are_differentiated() -> None:
    """As they arrive from shared memory."""
    sim = Simulator(load_scene("pushing"), num_envs=2)
    trajectory = sim.rollout(U)
    expected = sim.rollout_gradient(trajectory, q=np.ones_like(trajectory.q))
    arrays = ("u", "q", "v", "anchors", "anchored", "history", "tactile", "halvings", "status", "stopped_at")
    for name in arrays:
        getattr(trajectory, name).flags.writeable = False
    gradient = sim.rollout_gradient(trajectory, q=np.ones_like(trajectory.q))
    assert np.array_equal(gradient.u, expected.u)
    sim.contact_modes(trajectory)
    with pytest.raises(UsageError, match="q must be writable"):
        sim.rollout(U, out=trajectory)
