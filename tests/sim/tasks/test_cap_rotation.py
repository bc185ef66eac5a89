"""The cap rotation task: observation, reward, randomization, and the ends of its episodes."""

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.sim.tasks.cap_rotation import DEFAULT_RANDOMIZATION, FULL_RANDOMIZATION, CapRotation, CapRotationTask
from gelflow.sim.tasks.registry import make_task

# Swing, bend and curl of each finger: the tips close on the cap, then turn it.
CLOSE, TURN = np.tile([0.0, 0.5, 0.25], 3), np.tile([0.5, 0.1, -0.1], 3)
CAP = {"radius": 0.05, "center": (0.0, 0.0), "damping": 0.1}


def started(count: int = 2, *, task: CapRotationTask | None = None) -> tuple[CapRotation, np.random.Generator]:
    """A batch with the cap of the scene."""
    batch, rng = CapRotation(count, task=task or CapRotationTask(), threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng, options=CAP)
    return batch, rng


def test_fingers_start_clear_of_every_cap() -> None:
    batch, rng = CapRotation(200, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    tips = batch.fingertips()
    np.testing.assert_allclose(np.hypot(tips[..., 0], tips[..., 1]), 0.122, atol=1e-5)
    np.testing.assert_allclose(tips[..., 2], 0.035, atol=1e-5)
    center, radius = batch.info["privileged"][:, :2], batch.info["privileged"][:, 2]
    clearance = np.linalg.norm(tips[..., :2] - center[:, None], axis=-1) - radius[:, None]
    assert clearance.min() > 0.01 and not batch.info["touching"].any() and not batch.reward.any()
    assert np.abs(center).max() <= 0.02 and 0.02 <= radius.min() < 0.025 and 0.075 < radius.max() <= 0.08
    assert batch.info["privileged"][:, 3].min() >= 0.01 and batch.info["privileged"][:, 3].max() <= 0.7


def test_mass_of_the_cap_follows_its_radius() -> None:
    batch, rng = CapRotation(2, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng, options={"radius": [0.05, 0.025]})
    mass, inertia = batch.sim.param("cap.mass"), batch.sim.param("cap.inertia.zz")
    assert mass[0] == pytest.approx(400 * np.pi * 0.05**2 * 0.03) and mass[1] == pytest.approx(mass[0] / 4)
    np.testing.assert_allclose(inertia, mass * np.array([0.05, 0.025]) ** 2 / 2)


# Viscous fingertips slip; those on the smallest and stiffest caps may reach the end of their stroke.
@pytest.mark.parametrize(("friction", "success"), [("elastic", 1.0), ("viscous", 0.9)])
@pytest.mark.filterwarnings("ignore:scene dclaw")
def test_the_oracle_turns_caps_with_its_fingers(friction: str, success: float) -> None:
    batch, rng = CapRotation(32, friction=friction, preset="fast", threads=1), np.random.default_rng(4)
    batch.reset(batch.all, rng)
    while not (done := batch.terminated | batch.truncated).all():
        batch.step(batch.oracle(), rng, active=~done)
    assert batch.info["success"].mean() >= success
    assert batch.metrics["turned without touch [°]"].max() < 1


def test_actions_change_the_commanded_or_the_measured_angles() -> None:
    for use_target in (True, False):
        batch, rng = started(task=CapRotationTask(use_target=use_target, commanded=True))
        for _ in range(20):
            batch.step(np.tile(CLOSE, (2, 1)), rng)
        before = batch.sim.q[:, batch._joint_q].copy()
        batch.step(np.full((2, 9), 0.5), rng)
        ahead = np.abs(batch._commanded - before - 0.5 * batch.description.action_scale).max()
        assert ahead > 0.01 if use_target else ahead < 1e-12  # a finger that is blocked is pressed harder, or not


def test_joint_angles_of_the_oracle_are_the_inverse_of_its_fingertips() -> None:
    batch, rng = CapRotation(8, threads=1), np.random.default_rng(0)
    batch.reset(batch.all, rng)
    for _ in range(3):
        batch.step(rng.uniform(-1, 1, (8, 9)), rng)
    angles = batch.sim.q[:, batch._joint_q]
    np.testing.assert_allclose(batch._tips(angles), batch.fingertips(), atol=1e-12)
    np.testing.assert_allclose(batch._joint_angles(batch._tips(angles)), angles, atol=1e-12)


def test_closed_fingers_turn_the_cap_to_success() -> None:
    batch, rng = started(task=CapRotationTask(goal_angle=0.3))  # one sweep of all fingers together turns it by 0.4 rad
    for _ in range(25):
        batch.step(np.tile(CLOSE, (2, 1)), rng)
        if batch.info["touching"].all():
            break
    assert batch.info["touching"].all() and abs(batch.info["angle"]).max() < 0.2
    force, contact = batch.observation[:, 18:21], batch.observation[:, 21]
    assert (contact == 1).all() and (np.linalg.norm(force, axis=1) > 0.02).all()
    rate = 0.0
    while not (batch.terminated | batch.truncated).any():
        batch.step(np.tile(TURN, (2, 1)), rng)
        rate = max(rate, float(abs(batch.info["rate"]).max()))
    assert batch.terminated.all() and batch.info["success"].all() and not batch.info["above"].any()
    assert (batch.info["angle"] > 0.3).all() and (batch.reward > 45).all()
    # A cap turns no faster than fingertips that move by an action in each period: 0.16 m × 0.06 rad / 25 ms at 50 mm.
    assert rate < 0.16 * 0.06 * 3**0.5 / 0.025 / 0.05
    assert batch.metrics["largest rate [rad/s]"].max() >= rate > 0


def test_rotation_without_touch_is_counted() -> None:
    batch, rng = started()
    batch.sim.v[0, batch.scene.v("cap")] = 30.0  # a thrown cap coasts until its damping has stopped it
    for _ in range(8):
        batch.step(np.zeros((2, 9)), rng)
    coasted = batch.metrics["turned without touch [°]"]
    assert coasted[0] == pytest.approx(np.degrees(batch.info["angle"][0])) and coasted[0] > 1 and coasted[1] == 0
    batch.reset(np.array([True, False]), rng)
    assert coasted[0] == 0


def test_fingertip_above_the_cap_ends_the_episode() -> None:
    batch, rng = started()
    lift = np.tile([0.0, -1.0, 0.0], 3)
    for _ in range(40):
        batch.step(np.tile(lift, (2, 1)), rng)
        if batch.terminated.any():
            break
    assert batch.terminated.all() and batch.info["above"].all() and not batch.info["success"].any()
    assert (batch.reward < -50).all()


def test_reward_is_eq_26() -> None:
    task = CapRotationTask()
    touching = np.array([[True, False, False], [True, True, True]])
    reward = task.rewards(np.array([0.2, 0.8]), np.zeros(2), touching, np.full((2, 9), 0.5), np.array([True, False]))
    common = 0.005 * 9 * 0.25
    np.testing.assert_allclose(reward, [-1.0 - (np.pi / 4 - 0.2) ** 2 - common - 50, 50 - common])
    progress = CapRotationTask(reward="progress").rewards(
        np.array([0.2, 0.8]), np.array([0.1, 0.7]), touching, np.zeros((2, 9)), np.zeros(2, dtype=bool)
    )
    np.testing.assert_allclose(progress, [-0.4 + 20, 50 + 200 * (np.pi / 4 - 0.7)])


def test_observation_has_the_parts_of_the_task() -> None:
    assert [CapRotationTask(touch=t, commanded=c).observation_size for t in (False, True) for c in (False, True)] == [
        18,
        27,
        39,
        48,
    ]
    batch, rng = started(task=CapRotationTask(touch=False, commanded=True))
    np.testing.assert_allclose(batch.observation[:, 18:], 0, atol=1e-6)
    batch.step(np.tile(CLOSE, (2, 1)), rng)
    assert (batch.observation[:, 19] > 0).all()  # the servo lags behind its command
    np.testing.assert_allclose(batch.observation[:, :9], batch.sim.q[:, :9], rtol=1e-6)


def test_touch_of_the_observation_follows_from_the_markers_with_and_without_effects_of_real_pads() -> None:
    table = DEFAULT_RANDOMIZATION.replace(pad_gain=1e-9)  # an effect, so small that the reading is the same
    for randomization in (DEFAULT_RANDOMIZATION, table):
        batch, rng = CapRotation(2, randomization=randomization, threads=1), np.random.default_rng(0)
        batch.reset(batch.all, rng, options=CAP)
        for _ in range(20):
            batch.step(np.tile(CLOSE, (2, 1)), rng)
        pad = batch.scene.pads[0]
        forces = batch.sim.tactile()[:, batch.scene.marker_slice("tip1")]
        axes = pad.pose.matrix().T @ pad.axes * [1, 1, -1]
        np.testing.assert_allclose(batch.observation[:, 18:21], np.einsum("mij,nmj->ni", axes, forces), rtol=1e-5)
        center = forces[..., 2] @ (pad.positions - pad.pose.position) @ pad.pose.matrix()
        pressure = forces[..., 2].sum(1, keepdims=True)
        assert (pressure > 0.02).all() and batch.info["touching"][:, 0].all()
        np.testing.assert_allclose(batch.observation[:, 22:25], center / pressure / 0.01, rtol=1e-5, atol=1e-6)


def test_episodes_repeat_bit_for_bit_with_any_number_of_threads() -> None:
    runs = []
    for threads in (1, 2):
        batch = CapRotation(3, threads=threads, randomization=FULL_RANDOMIZATION)
        rng = np.random.default_rng(5)
        batch.reset(batch.all, rng)
        for _ in range(4):
            batch.step(rng.uniform(-1, 1, (3, 9)), rng)
        runs.append((batch.observation.copy(), batch.reward.copy()))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])


def test_bad_options_are_named() -> None:
    with pytest.raises(UsageError, match="reward must be one of paper, progress, got 'sparse'"):
        CapRotationTask(reward="sparse")
    batch = make_task("cap", 1, randomization=DEFAULT_RANDOMIZATION.replace(radius=0.03))
    with pytest.raises(UsageError, match="cap: reset has no option 'size'"):
        batch.reset(batch.all, np.random.default_rng(0), options={"size": 1})
    batch.reset(batch.all, np.random.default_rng(0))
    assert batch.info["privileged"][0, 2] == 0.03


def test_picture_of_the_hand() -> None:
    batch, _ = started(1)
    picture = batch.render(0)
    assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
