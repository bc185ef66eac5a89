"""Position, orientation and scale of shapes, points and markers as parameters, compared with built models."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gelflow.errors import UsageError
from gelflow.sim import _core
from gelflow.sim.scene import FRICTION_LAWS, INTEGRATORS, load_scene
from gelflow.sim.scene.geometry.sampling import box_surface, capsule
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import SCENES

Array = NDArray[np.float64]

NUMBERS = {"kn": 200.0, "kt": 2.0, "mu": 0.4, "kd": 20.0}
POS, TURN, SCALE = np.array([2e-3, -1e-3, -4e-3]), np.array([0.02, -0.01, 0.3]), np.array([1.1, 0.95, 1.2])
FRAME = np.array([3e-3, 1e-3, 0.0]), Rotation.from_rotvec([0.1, 0.2, -0.3])  # pose of points and markers in their body


def quat(rotation: Rotation) -> Array:
    return np.roll(rotation.as_quat(), 1)


def moved(points: Array, what: str, scale: Array) -> Array:
    """Points of FRAME, displaced as by parameters."""
    pos, frame = FRAME
    if what == "as built":
        return np.asarray(pos + frame.apply(points))
    return np.asarray(pos + POS + (frame * Rotation.from_rotvec(TURN)).apply(points * scale))


def build(law: str, shape: str, points: str, markers: str) -> Simulator:
    """A cloud on slides and a ball joint above a box; each placed when built or by parameters."""
    spec = _core.ModelSpec()
    spec.tolerance = 1e-13
    hand = spec.add_body(_core.BodyDef(name="hand", pos=(0, 0, 0.02), mass=0.05, inertia=(1e-5, 1e-5, 1e-5, 0, 0, 0)))
    for name, axis in (("x", (1, 0, 0)), ("z", (0, 0, 1))):
        spec.add_joint(_core.JointDef(name=name, body=hand, type="slide", axis=axis, damping=0.5))
    spec.add_joint(_core.JointDef(name="ball", body=hand, type="ball", damping=1e-3))
    cloud = capsule(0.012, 0.0, count=80)[0]
    pos, frame = FRAME
    at: dict[str, Any] = {"pos": pos, "quat": quat(frame)}
    turned = Rotation.from_rotvec(TURN)
    box = _core.ShapeDef(name="box", kind="box", size=(0.03, 0.02, 0.01))
    if shape == "moved":
        box.pos, box.quat = POS, quat(turned)
    top = spec.add_shape(box)
    cloud_of_contact = spec.add_points(
        _core.PointsDef(name="cloud", body=hand, points=moved(cloud, points, SCALE), **at)
    )
    numbers: dict[str, Any] = {**NUMBERS, "law": law, "ks": 100.0 if law == "elastic" else 0.0}
    spec.add_contact(_core.ContactDef(name="press", points=cloud_of_contact, shape=top, **numbers))
    axes = (frame * turned if markers == "moved" else frame).as_matrix()
    spec.add_pad(
        _core.PadDef(
            name="skin",
            body=hand,
            positions=moved(cloud, markers, np.ones(3)),
            axes=np.tile(axes, (80, 1, 1)),
            shapes=[top],
            **at,
            **numbers,
        )
    )
    sim = Simulator(_core.Model(spec))
    sim.q[0, 1] = 1e-3
    return sim


def move(sim: Simulator, owner: str, names: tuple[str, ...]) -> None:
    for name, values in (("pos", POS), ("turn", TURN), ("scale", SCALE)):
        for axis, value in zip("xyz" if name in names else "", values, strict=False):
            sim.param(f"{owner}.{name}.{axis}")[:] += value - (name == "scale")


@pytest.mark.parametrize("law", FRICTION_LAWS)
@pytest.mark.parametrize("what", ["shape", "points", "markers"])
def test_placement_by_parameters_equals_placement_when_built(what: str, law: str) -> None:
    places = {"shape": "as built", "points": "as built", "markers": "as built"}
    built, sim = build(law, **{**places, what: "moved"}), build(law, **places)
    owner = {"shape": "box.shape", "points": "cloud.points", "markers": "skin.markers"}[what]
    move(sim, owner, ("pos", "turn", "scale") if what == "points" else ("pos", "turn"))
    largest_force = 0.0
    for _ in range(20):
        for each in (built, sim):
            each.step(np.zeros(0))
            each.check()
        np.testing.assert_allclose(sim.q, built.q, rtol=0, atol=1e-11)
        np.testing.assert_allclose(sim.tactile(), built.tactile(), rtol=0, atol=1e-8)
        largest_force += float(np.abs(built.wrenches() if what == "points" else built.tactile()).max())
    assert largest_force > 0.1 and np.abs(built.v).max() > 1e-3


def pressed_by(points: Array, areas: Array, depth: float) -> tuple[Simulator, Array]:
    """Points with stiffness per area on a plane, the lowest at `depth`."""
    spec = _core.ModelSpec()
    body = spec.add_body(_core.BodyDef(name="part", mass=0.1, inertia=(1e-5, 1e-5, 1e-5, 0, 0, 0)))
    spec.add_joint(_core.JointDef(name="part", body=body, type="free"))
    plane = spec.add_shape(_core.ShapeDef(name="plane", kind="plane"))
    sampled = spec.add_points(_core.PointsDef(name="part", body=body, points=points, weights=areas.sum(1), areas=areas))
    spec.add_contact(_core.ContactDef(name="stand", points=sampled, shape=plane, kn=1e6, kt=1.0, mu=0.5, kd=1.0))
    sim = Simulator(_core.Model(spec))
    sim.q[0, 2] = -points[:, 2].min() - depth
    return sim, sim.wrenches()[0, 0].copy()


@pytest.mark.parametrize("scale", [(1.2, 1.2, 1.2), (1.3, 0.8, 1.1)])
def test_scaled_points_equal_those_of_a_larger_box(scale: tuple[float, float, float]) -> None:
    half = np.array([0.02, 0.03, 0.01])
    larger, expected = pressed_by(*box_surface(tuple(half * scale), (4, 5, 3)), 1e-3)
    sim, before = pressed_by(*box_surface(tuple(half), (4, 5, 3)), 1e-3)
    for axis, value in zip("xyz", scale, strict=True):
        sim.param(f"part.points.scale.{axis}")[:] = value
    sim.q[:] = larger.q
    np.testing.assert_allclose(sim.wrenches()[0, 0], expected, rtol=1e-9, atol=1e-12)
    # Weights of the lower face; its edge points are shared with the sides and count half of the adjacent area.
    assert abs(expected[5] / before[5] - scale[0] * scale[1]) < 0.3


def test_weights_of_a_sphere_grow_with_the_square_of_its_scale() -> None:
    larger, expected = pressed_by(*capsule(0.015, 0.0, count=200), 2e-3)
    sim, _ = pressed_by(*capsule(0.01, 0.0, count=200), 2e-3)
    for axis in "xyz":
        sim.param(f"part.points.scale.{axis}")[:] = 1.5
    sim.q[:] = larger.q
    np.testing.assert_allclose(sim.wrenches()[0, 0], expected, rtol=1e-9, atol=1e-12)


def test_scale_of_an_exact_sphere_is_its_size() -> None:
    sim = Simulator(load_scene("rolling", overrides={"pads.pad.rows": 2, "pads.pad.cols": 2}), num_envs=2)
    sim.param("ball.points.scale.x")[1] = 1.25
    sim.q[:, sim.joint_q("pad_z")] = 1.0
    sim.q[1, sim.joint_q("ball") + 2] = 0.025
    sim.step(np.array([0, 0, 0.25]), 100)  # the force carries the pad's weight: no contact
    np.testing.assert_allclose(sim.q[:, sim.joint_q("ball") + 2], [0.02, 0.025], atol=1e-5)


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_has_placement_parameters(name: str) -> None:
    scene = load_scene(name)
    sim = Simulator(scene)
    for owner, pos in [
        *((f"{shape.name}.shape", shape.pose.position) for shape in scene.shapes),
        *((f"{points.name}.points", points.pose.position) for points in scene.points),
        *((f"{pad.name}.markers", pad.pose.position) for pad in scene.pads),
    ]:
        np.testing.assert_array_equal([sim.param(f"{owner}.pos.{axis}")[0] for axis in "xyz"], pos)
        assert not any(sim.param(f"{owner}.turn.{axis}")[0] for axis in "xyz")
    for points in scene.points:
        assert all(sim.param(f"{points.name}.points.scale.{axis}")[0] == 1 for axis in "xyz")


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("precision", ["double", "single"])
def test_displaced_wall_pushes_the_part(precision: Any, integrator: str) -> None:
    """Each environment has its own hole; a displaced wall pushes the part."""
    scene = load_scene("insertion", overrides={"integrator": integrator})
    sim = Simulator(scene, num_envs=3, precision=precision)
    part = sim.joint_q("part")
    sim.q[:, part : part + 3] = 0, 0, 0.0305  # 500 µm above the floor, in the hole
    shift = np.array([0, 5e-3, 0])
    sim.param("wall_left.shape.pos.x")[:] += shift
    sim.step(np.zeros(scene.nu), 20)
    sim.check()
    x = sim.q[:, part]
    np.testing.assert_array_equal(x[[0, 2]], x[0])
    assert x[1] - x[0] > 1e-3


@pytest.mark.parametrize("name", ["wall_left.shape.pos.x", "floor.shape.turn.y", "part.points.scale.z"])
def test_position_that_is_not_finite_is_refused(name: str) -> None:
    scene = load_scene("insertion")
    sim = Simulator(scene, num_envs=2)
    sim.param(name)[1] = np.nan
    with pytest.raises(UsageError, match=f"^environment 1: parameter '{name}' must be a number, got nan"):
        sim.step(np.zeros(scene.nu), 2)
    np.testing.assert_array_equal(sim.q, np.tile(scene.q0, (2, 1)))
