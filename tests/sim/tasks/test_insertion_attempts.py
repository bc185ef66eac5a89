"""Physics and observations of simulated insertion attempts."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import MIN_DIVISORS, TactileFrame, flow_map
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.insertion import ROLLOUT_SIZE, InsertionAttempts, insertion_scene
from gelflow.sim.tasks.insertion_randomization import DEFAULT_RANDOMIZATION, NOMINAL, simulator_parameters
from gelflow.sim.tasks.randomization import Randomization
from gelflow.task import INSERTION, PUBLISHED_INSERTION, InsertionTask

WEIGHT = 0.063 * 9.8  # of the part [N]
SILENT = NOMINAL.replace(noise=(1e-30, 1e-30))
STIFF = SILENT.replace(hole_kn=2e4, stop_shear=0.03)  # walls into which no deep descent presses a part


def poses(*millimetres_degrees: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.array(millimetres_degrees) * [1e-3, 1e-3, np.pi / 180]


def attempted(misalignment: NDArray[np.float64], **options: Any) -> tuple[InsertionAttempts, Any]:
    rng = np.random.default_rng(0)
    attempts = InsertionAttempts(len(misalignment), **{"randomization": SILENT, **options})
    attempts.draw(rng, misalignment=misalignment)
    return attempts, attempts.attempt(rng)


def held(friction: str) -> tuple[Simulator, NDArray[np.float64], int]:
    """A part at rest in the gripper without other contact, the holding controls, and the index of its height in q."""
    scene = insertion_scene(friction=friction)
    attempts = InsertionAttempts(1, scene=scene, randomization=SILENT)
    attempts.draw(np.random.default_rng(0))
    return attempts.sim, attempts._u.copy(), scene.q("part").start + 2


def test_grasped_part_does_not_creep_under_the_elastic_law() -> None:
    sim, u, z = held("elastic")
    before = sim.q[0].copy()
    sim.step(u, 200)
    assert abs(sim.q[0, z] - before[z]) < 1e-8  # in 1 s
    np.testing.assert_allclose(sim.q[0], before, atol=1e-6)
    assert (sim.status == 0).all()


def test_grasped_part_creeps_at_the_predicted_rate_under_the_viscous_law() -> None:
    """66 points of 80 N s/m carry the weight: the rate is m g / 5280 N s/m."""
    sim, u, z = held("viscous")
    before = sim.q[0, z]
    sim.step(u, 100)
    assert (before - sim.q[0, z]) / 0.5 == pytest.approx(WEIGHT / (66 * 80), rel=1e-3)


@pytest.mark.parametrize("friction", ["viscous", "elastic"])
def test_the_pads_carry_the_weight_and_the_grasp_force(friction: str) -> None:
    sim, _, _ = held(friction)
    names = list(sim.model.contact_names)
    left, right = (sim.wrenches()[0, names.index(f"pad_{side}"), 3:] for side in ("left", "right"))
    np.testing.assert_allclose(left, [-12, 0, -WEIGHT / 2], atol=2e-3)  # on the pads
    np.testing.assert_allclose(right, [12, 0, -WEIGHT / 2], atol=2e-3)
    reading = sim.tactile()[0]
    assert (reading[..., 2] > 0).all()  # pressed
    assert (reading[..., 0] > 0).all()  # the weight acts towards the fingertip, downwards
    assert np.abs(reading[..., 1]).max() < 1e-3 * reading[..., 0].min()


def test_the_gripper_presses_with_the_largest_force_of_a_lab_file() -> None:
    force = 80.0
    attempts = InsertionAttempts(1, randomization=SILENT.replace(grasp_force=force))
    attempts.draw(np.random.default_rng(0))
    for side in ("left", "right"):
        wrench = attempts.sim.wrenches()[0, attempts.sim.model.contact_names.index(f"pad_{side}")]
        assert abs(wrench[3]) == pytest.approx(force, rel=1e-3)


def test_a_part_that_slides_out_of_the_grip_is_not_attempted() -> None:
    """Two pads hold 2 µ F: 5 N carry 0.5 kg and not 0.52 kg."""
    for mass, held_in_grip in ((0.5, True), (0.52, False)):
        part = dataclasses.replace(INSERTION.part, density=mass / math.prod(INSERTION.part.size))
        weak = SILENT.replace(grasp_force=5.0, pad_mu=0.5)
        _, result = attempted(poses((3, 0, 0)), task=dataclasses.replace(INSERTION, part=part), randomization=weak)
        assert bool(result.failed[0]) is not held_in_grip


@pytest.mark.parametrize(
    ("task", "values", "lowest"),
    [(PUBLISHED_INSERTION, SILENT, 24.7e-3), (INSERTION, STIFF, 24.4e-3)],
    ids=["1.1 mm", "4.1 mm, stiff walls"],
)
def test_aligned_parts_are_inserted_and_misaligned_ones_are_not(
    task: InsertionTask, values: Randomization, lowest: float
) -> None:
    cases = poses((0, 0, 0), (2.1, 0, 0), (0, -2.1, 0), (0, 0, 4), (2.6, 0, 0), (0, -2.6, 0), (0, 0, 8), (6, 6, 10))
    _, result = attempted(cases, task=task, randomization=values)
    assert result.inserted.tolist() == [True] * 4 + [False] * 4
    assert not result.failed.any()
    np.testing.assert_allclose(result.height[0], 25.5e-3 - task.descent, atol=5e-5)
    assert (result.height[4:] > lowest).all()


def test_insertion_agrees_with_geometry_under_randomized_physics() -> None:
    """Parts are inserted exactly when their outline fits the hole, within the compliance of gels and walls."""
    attempts = InsertionAttempts(48)
    rng = np.random.default_rng(3)
    blocked = fitting = 0
    for _ in range(2):
        attempts.draw(rng)
        attempts.pose = rng.uniform(-1, 1, (48, 3)) * [4e-3, 4e-3, 0.12]
        result = attempts.attempt(rng)
        x, y, yaw = np.abs(attempts.pose.T)
        cos, sin = np.cos(yaw), np.sin(yaw)
        margin = np.minimum(19.75e-3 - x - 17.5e-3 * cos - 25e-3 * sin, 27.25e-3 - y - 25e-3 * cos - 17.5e-3 * sin)
        assert not result.failed.any()
        assert not result.inserted[margin < -0.3e-3].any()
        assert result.inserted[margin > 0].all()
        blocked += int((margin < 0).sum())
        fitting += int((margin > 0).sum())
    assert blocked > 30 and fitting > 8


def test_mirrored_misalignment_gives_mirrored_flow_map() -> None:
    """x → −x swaps the fingers; on the pads, y and the columns change sign. Detects a rotated pad frame."""
    _, result = attempted(poses((1.5, 3, 4), (-1.5, 3, -4)), task=PUBLISHED_INSERTION)
    maps = result.image.reshape(2, 2, 2, 13, 10)
    mirrored = maps[1][::-1, :, :, ::-1] * np.array([1, -1])[None, :, None, None]
    np.testing.assert_allclose(
        maps[0], mirrored, atol=0.01
    )  # the left jaw is position controlled, the right one force controlled
    assert np.abs(maps[0] - maps[1]).max() > 0.05


def test_flow_map_shows_the_location_of_the_contact() -> None:
    """The rim pushes upwards, towards the base of the fingers; contact at the back edge rotates the part."""
    _, result = attempted(poses((0, 4, 0), (0, -4, 0)))
    maps = result.image.reshape(2, 2, 2, 13, 10)
    assert (maps[:, :, 0].mean((2, 3)) < 0).all()
    left, right = maps[:, 0], maps[:, 1]
    top, bottom = left[:, 1, :4].mean((1, 2)), left[:, 1, -4:].mean((1, 2))
    assert top[0] < bottom[0] and top[1] > bottom[1]  # the transverse shear rotates with the part
    np.testing.assert_allclose(left[:, 1], -right[:, 1, :, ::-1], atol=0.01)


@pytest.mark.parametrize("sign", [1, -1])
def test_contact_at_the_end_of_a_descent_has_either_direction(sign: int) -> None:
    """The rim pushes the part up, against the direction of the markers' x axis."""
    attempts, _ = attempted(poses((0, 4, 0)))
    change = np.zeros((1, attempts.scene.num_markers, 2))
    for share, contact in ((0.2, False), (0.5, True)):
        change[..., 0] = sign * share * attempts.stop_shear[0]
        assert attempts._in_contact(np.array([0]), change).tolist() == [contact]


def test_flow_map_is_independent_of_the_descent_speed() -> None:
    """Frames are selected by depth: a robot descends ten times more slowly and observes the same map."""
    cases = poses((3, 0, 0), (0, 4, 0), (2, 4, 8))
    _, fast = attempted(cases)
    _, slow = attempted(cases, steps=450)
    assert np.linalg.norm(fast.image - slow.image) < 0.05 * np.linalg.norm(fast.image)
    np.testing.assert_allclose(fast.divisor, slow.divisor, rtol=0.02)


def test_observation_is_the_flow_map_of_the_frames() -> None:
    """The batched maps equal those of the robot pipeline for the same frames."""
    attempts, result = attempted(poses((2, 3, 5), (-3, 1, 0)))
    grid = INSERTION.grid

    def frame(reading: NDArray[Any], env: int) -> TactileFrame:
        shear = reading[env, :, :2].reshape(2, -1, 2).astype(np.float32)
        return TactileFrame(
            shear=shear,
            valid=np.ones(shear.shape[:2], dtype=bool),
            positions=grid.positions().astype(np.float32),
            stamp=0.0,
            unit="N",
            grid=grid,
        )

    last = attempts.sim.tactile().copy()
    for env in range(2):
        expected = flow_map([frame(last, env)], frame(attempts._grasp_shear, env), grid=grid)
        np.testing.assert_allclose(result.image[env], expected.image, atol=1e-5)
        assert result.divisor[env] == pytest.approx(expected.divisor, rel=1e-5)
        assert result.divisor[env] > MIN_DIVISORS["N"]


def test_frames_are_recorded_at_the_depths_of_the_task() -> None:
    task = dataclasses.replace(PUBLISHED_INSERTION, reference_depth=0.2e-3, frame_depths=(0.6e-3, 0.8e-3, 1.1e-3))
    cases = poses((3, 0, 0), (0, 4, 0))
    _, several = attempted(cases, task=task)
    assert several.image.shape == (2, 12, 13, 10)
    strength = np.abs(several.image.reshape(2, 3, -1)).sum(2)
    assert (np.diff(strength, axis=1) > 0).all()  # forces increase with depth
    with pytest.raises(UsageError, match=r"frame depth 0\.005 m is outside the descent"):
        attempted(cases, task=dataclasses.replace(INSERTION, frame_depths=(5e-3,)))


def test_contact_stops_the_descent() -> None:
    """The frame is the one at the stop: weaker than at full depth, with the same pattern."""
    caught, through = (3e-3, 2e-3, 0.05), (0.0, 0.0, 0.0)
    misalignment = np.array([caught, through])
    gentle = SILENT.replace(stop_shear=5e-3)
    _, stopped = attempted(misalignment, task=PUBLISHED_INSERTION, randomization=gentle)
    _, full = attempted(misalignment, task=PUBLISHED_INSERTION, randomization=SILENT.replace(stop_shear=9.0))
    assert 5e-3 < stopped.divisor[0] < 0.7 * full.divisor[0]
    assert np.abs(stopped.image[0] - full.image[0]).mean() < 0.15
    np.testing.assert_array_equal(stopped.inserted, [False, True])
    _, deep = attempted(misalignment, randomization=gentle)
    np.testing.assert_allclose(deep.image[0], stopped.image[0], atol=0.01)  # the limit of the depth is not reached
    np.testing.assert_array_equal(deep.inserted, [False, True])


def test_every_attempt_starts_from_the_same_grasp() -> None:
    attempts, first = attempted(poses((2, 3, 5)))
    again = attempts.attempt(np.random.default_rng(1))
    np.testing.assert_allclose(again.image, first.image, atol=1e-6)
    attempts.pose = poses((-4, 3, -2))
    other = attempts.attempt(np.random.default_rng(1))
    assert np.abs(other.image - first.image).max() > 0.05


def test_results_depend_neither_on_the_batch_nor_on_threads() -> None:
    cases = poses((2, 3, 5), (0, 4, 0), (5, -5, 3))
    _, together = attempted(cases, threads=2)
    for i, case in enumerate(cases):
        _, alone = attempted(case[None], threads=1)
        assert (alone.image[0] == together.image[i]).all()


def test_some_environments_attempt_and_draw_while_the_others_rest() -> None:
    """More environments than one rollout simulates; the result of a part does not depend on its place."""
    quiet = DEFAULT_RANDOMIZATION.replace(start_height=0.0, noise=1e-40)
    attempts = InsertionAttempts(ROLLOUT_SIZE + 3, randomization=quiet)
    rng = np.random.default_rng(5)
    attempts.draw(rng)
    every = attempts.attempt(rng)
    some = np.arange(ROLLOUT_SIZE + 3) % 20 == 6
    result = attempts.attempt(rng, which=some)
    np.testing.assert_array_equal(result.image, every.image[some])
    np.testing.assert_array_equal(result.height, every.height[some])
    poses_before = attempts.pose.copy()
    attempts.draw(rng, which=some)
    np.testing.assert_array_equal(attempts.pose[~some], poses_before[~some])
    assert (attempts.pose[some] != poses_before[some]).all()
    np.testing.assert_array_equal(attempts.attempt(rng, which=~some).image, every.image[~some])


@pytest.mark.parametrize("elastic", [True, False])
def test_sampled_parameters_lie_within_their_ranges(elastic: bool) -> None:
    friction = "elastic" if elastic else "viscous"
    sampled = DEFAULT_RANDOMIZATION.sample(np.random.default_rng(0), 500, friction=friction)
    params = simulator_parameters(sampled, elastic=elastic)
    for name, limits in {
        "pad_left.kn": (2e3, 1.4e4),
        "right.kd": (0, 100),
        "arm_z.kp": (200, 3e5),
        "part_hole/wall_back.kn": (2.5e3, 2e4),
    }.items():
        values = params[name]
        assert limits[0] <= values.min() and values.max() <= limits[1]
        assert values.max() - values.min() > 0.9 * (limits[1] - limits[0])
    assert ("pad_left.ks" in params) == elastic
    np.testing.assert_array_equal(params["pad_left.mu"], params["pad_right.mu"])
    assert sampled["grasp_force"].min() >= 2.5 and sampled["grasp_force"].max() <= 16
    with pytest.raises(UsageError, match=r"pad_mu: a range must be \(low, high\)"):
        NOMINAL.replace(pad_mu=(2.0, 1.0))


def test_sampled_parameters_exist_under_both_friction_laws() -> None:
    for friction in ("viscous", "elastic"):
        attempts = InsertionAttempts(2, scene=insertion_scene(friction=friction))
        attempts.draw(np.random.default_rng(0))
        assert not attempts.attempt(np.random.default_rng(0)).failed.any()


def test_scene_with_another_marker_grid_raises() -> None:
    task = dataclasses.replace(INSERTION, grid=dataclasses.replace(INSERTION.grid, rows=12))
    assert InsertionAttempts(1, task=task).attempt(np.random.default_rng(0)).image.shape == (1, 4, 12, 10)
    with pytest.raises(UsageError, match="the scene's pads must be left, right with the task's markers"):
        InsertionAttempts(1, task=task, scene=insertion_scene(INSERTION))
