"""The reference generator of EGM, cycle by cycle, without process, socket or clock."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gelflow.errors import SafetyError, UsageError
from gelflow.geometry import PoseTuple, angle_between
from gelflow.real.egm.codec import EgmFeedback
from gelflow.real.egm.config import EgmConfig
from gelflow.real.egm.reference_generator import EgmFlag, ReferenceGenerator
from gelflow.real.egm.target import Target, check_target, tool_frame
from gelflow.real.kinematics import HOME, Joints, forward, inverse

CONFIG = EgmConfig(workspace_min=(0.35, -0.05, 0.25), workspace_max=(0.45, 0.05, 0.35), joint_speed=math.radians(30))
CYCLE = CONFIG.cycle
DOWN = (0.0, 0.0, 1.0, 0.0)
START = (0.40, 0.0, 0.30)


def feedback(cycle: int, position: tuple[float, float, float] = START, **changes: object) -> EgmFeedback:
    joints = inverse(position, DOWN, near=HOME)
    whole = EgmFeedback(sequence=cycle, time=cycle * CYCLE, position=position, quaternion=DOWN, joints=joints)
    return dataclasses.replace(whole, **changes)  # type: ignore[arg-type]


def target(position: tuple[float, float, float], *, expires: float = math.inf, **changes: object) -> Target:
    expires = min(expires, 1e9)
    whole = Target(position, DOWN, expires=expires, speed=CONFIG.max_speed, turn_speed=CONFIG.max_turn_speed)
    return dataclasses.replace(whole, **changes)  # type: ignore[arg-type]


class Robot:
    """Feeds a reference generator; the pose of the robot is the reference of `lag` cycles ago."""

    def __init__(self, config: EgmConfig = CONFIG, lag: int = 4) -> None:
        self.generator = ReferenceGenerator(config)
        self.cycle = 0
        self.sent: list[PoseTuple] = []
        self.lag = lag

    @property
    def now(self) -> float:
        return self.cycle * CYCLE

    def step(self, count: int = 1, **changes: object) -> EgmFlag:
        flags = EgmFlag(0)
        for _ in range(count):
            self.cycle += 1
            position, quaternion = self.sent[-self.lag] if len(self.sent) >= self.lag else (START, DOWN)
            message = feedback(self.cycle, **changes)  # type: ignore[arg-type]
            message = dataclasses.replace(message, position=position, quaternion=quaternion)
            joints = inverse(position, quaternion, near=message.joints)
            assert self.generator.observe(dataclasses.replace(message, joints=joints), self.now)
            reference, flags = self.generator.advance(self.now)
            if reference is not None:
                self.sent.append(reference)
        return flags

    def events(self) -> list[str]:
        return [f"{event.kind}: {event.text}" for event in self.generator.events]


def test_first_reference_equals_the_feedback_and_nothing_moves_without_a_target() -> None:
    robot = Robot()
    flags = robot.step(50)
    assert all(sent == (START, DOWN) for sent in robot.sent)
    assert flags == EgmFlag.MOTORS_ON | EgmFlag.FOLLOWING | EgmFlag.HOLD


def test_reference_equals_the_feedback_until_the_controller_follows() -> None:
    generator = ReferenceGenerator(CONFIG)
    for cycle, x in enumerate((0.40, 0.41, 0.42), start=1):
        generator.observe(feedback(cycle, (x, 0.0, 0.3), mci="stopped"), cycle * CYCLE)
        assert generator.advance(cycle * CYCLE)[0] == ((x, 0.0, 0.3), DOWN)
    generator.observe(feedback(4, (0.421, 0.0, 0.3)), 4 * CYCLE)
    assert generator.advance(4 * CYCLE)[0] == ((0.421, 0.0, 0.3), DOWN)
    # From now on the reference is frozen, even if the arm sags.
    generator.observe(feedback(5, (0.4205, 0.0, 0.3)), 5 * CYCLE)
    assert generator.advance(5 * CYCLE)[0] == ((0.421, 0.0, 0.3), DOWN)


def test_target_is_reached_exactly_within_the_bounds_of_speed_and_ramp() -> None:
    robot = Robot()
    robot.step()
    turned = (0.0, math.sin(0.05), math.cos(0.05), 0.0)  # 0.1 rad about the tool's z
    goal = dataclasses.replace(target((0.408, 0.004, 0.296)), quaternion=turned)
    robot.generator.set_target(goal, robot.now)
    robot.step(400)
    assert robot.sent[-1] == (goal.position, goal.quaternion)
    positions = np.array([p for p, _ in robot.sent])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    turns = np.array([angle_between(a[1], b[1]) for a, b in itertools.pairwise(robot.sent)])
    assert steps.max() <= CONFIG.max_speed * CYCLE * (1 + 1e-9)
    assert turns.max() <= CONFIG.max_turn_speed * CYCLE * (1 + 1e-6)
    # The rotation takes longer than the translation (0.1 rad at 10°/s), so only the rotation runs at full speed.
    assert turns.max() == pytest.approx(CONFIG.max_turn_speed * CYCLE, rel=1e-3)
    # The change of speed is bounded by the ramp, except for the last step to the target.
    assert np.abs(np.diff(steps[:-1])).max() <= CONFIG.max_speed * CYCLE * (CYCLE / CONFIG.ramp_time) * 2.5
    # A straight line.
    along = np.array(goal.position) - START
    off = np.cross(positions - START, along / np.linalg.norm(along))
    assert np.abs(off).max() < 1e-12


def test_slow_target_moves_at_its_speed() -> None:
    """The descent at 0.5 mm/s advances 2 µm per cycle."""
    robot = Robot()
    robot.step()
    robot.generator.set_target(target((0.40, 0.0, 0.299), speed=0.5e-3), robot.now)
    robot.step(150)
    heights = [p[2] for p, _ in robot.sent]
    assert np.diff(heights)[-100:] == pytest.approx(np.full(100, -2e-6), rel=1e-6)


def test_renewed_target_keeps_the_speed_and_reversed_target_starts_from_rest() -> None:
    robot = Robot()
    robot.step()
    for _ in range(20):
        robot.generator.set_target(target((0.44, 0.0, 0.30)), robot.now)
        robot.step(5)
    x = np.array([p[0] for p, _ in robot.sent])
    assert np.diff(x)[-1] == pytest.approx(CONFIG.max_speed * CYCLE)
    robot.generator.set_target(target((0.38, 0.0, 0.30)), robot.now)
    robot.step()
    back = robot.sent[-1][0][0] - robot.sent[-2][0][0]
    assert -CONFIG.max_speed * CYCLE * CYCLE / CONFIG.ramp_time * 1.01 <= back < 0


def test_expired_target_freezes_the_reference() -> None:
    robot = Robot()
    robot.step()
    robot.generator.set_target(target((0.44, 0.0, 0.30), expires=robot.now + 0.1), robot.now)
    robot.step(25)
    frozen = robot.sent[-1]
    assert frozen[0][0] > START[0]
    flags = robot.step(50)
    assert EgmFlag.HOLD in flags
    assert robot.sent[-1] == robot.sent[-50]
    assert robot.sent[-1][0][0] - frozen[0][0] <= CONFIG.max_speed * CYCLE
    assert "hold: the target expired" in robot.events()


def test_reference_waits_for_a_robot_that_does_not_follow() -> None:
    robot = Robot(lag=10**6)  # does not move
    robot.step()
    robot.generator.set_target(target((0.44, 0.0, 0.30)), robot.now)
    flags = robot.step(500)
    assert EgmFlag.LAGGING in flags
    assert robot.sent[-1][0][0] - START[0] <= CONFIG.max_lead + CONFIG.max_speed * CYCLE


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [("motors", "off", "motors off"), ("rapid", "stopped", "RAPID stopped"), ("mci", "error", "EGM motion error")],
)
def test_stopped_controller_latches_until_reset(field: str, value: str, reason: str) -> None:
    robot = Robot()
    robot.step(5)
    robot.generator.set_target(target((0.42, 0.0, 0.30)), robot.now)
    robot.step(5)
    count = len(robot.sent)
    robot.step(1, **{field: value})
    assert robot.generator.latched == reason
    # The controller is ready again and new targets arrive: still nothing is sent.
    for _ in range(20):
        robot.step()
        robot.generator.set_target(target((0.42, 0.0, 0.30)), robot.now)
    assert len(robot.sent) == count
    robot.generator.reset(robot.now)
    here = robot.sent[-robot.lag]
    robot.step(20)
    assert robot.sent[-1] == here, "after a reset the reference equals the feedback, and no earlier target is followed"


def test_sequence_restart_latches_while_following() -> None:
    robot = Robot()
    robot.step(100)
    assert robot.generator.observe(feedback(0, time=101 * CYCLE), robot.now + CYCLE)
    assert "EGM was restarted: the message count went back from 100 to 0" in robot.generator.latched
    assert robot.generator.advance(robot.now) == (None, robot.generator.flags | EgmFlag.LATCHED)


def test_sequence_restart_before_following_is_accepted() -> None:
    generator = ReferenceGenerator(CONFIG)
    generator.observe(feedback(500, mci="stopped"), 1.0)
    assert generator.observe(feedback(0, time=3.0, mci="stopped"), 1.004)
    assert not generator.latched
    assert generator.observe(feedback(1, time=3.004), 1.008)
    assert EgmFlag.FOLLOWING in generator.advance(1.008)[1]


def test_duplicates_and_late_messages_are_not_answered_and_a_gap_is_flagged() -> None:
    generator = ReferenceGenerator(CONFIG)
    assert generator.observe(feedback(10), 0.0)
    assert not generator.observe(feedback(10), 0.001)
    assert generator.observe(feedback(12), 0.008)
    assert EgmFlag.LOST in generator.flags
    assert not generator.observe(feedback(11), 0.009)
    assert not generator.latched
    assert generator.observe(feedback(13), 0.012)
    assert EgmFlag.LOST not in generator.flags


def test_stale_feedback_holds_then_stops() -> None:
    robot = Robot()
    robot.step(3)
    robot.generator.set_target(target((0.44, 0.0, 0.30)), robot.now)
    robot.step(3)
    robot.generator.check_age(robot.now + 0.019)
    assert robot.generator.target is not None
    robot.generator.check_age(robot.now + 0.021)
    assert robot.generator.target is None
    assert not robot.generator.latched
    robot.generator.check_age(robot.now + 0.101)
    assert "no EGM message for 0.101 s" in robot.generator.latched


def test_late_message_after_a_silence_latches() -> None:
    robot = Robot()
    robot.step(3)
    robot.generator.observe(feedback(4), robot.now + 0.5)
    assert "no EGM message for 0.5" in robot.generator.latched


def test_first_stop_reason_is_kept() -> None:
    robot = Robot()
    robot.step()
    robot.generator.latch("the operator said so", robot.now)
    robot.step(motors="off")
    assert robot.generator.latched == "the operator said so"


NAN, INF = math.nan, math.inf
WRONG = [
    (target((0.46, 0.0, 0.30)), "x = 0.460000 m is outside the workspace"),
    (target((0.40, 0.0, 0.2499)), "z = 0.249900 m is outside"),
    (target((NAN, 0.0, 0.30)), "not finite"),
    (target((0.40, INF, 0.30)), "not finite"),
    (dataclasses.replace(target(START), quaternion=(NAN, 0.0, 1.0, 0.0)), "not finite"),
    (dataclasses.replace(target(START), quaternion=(0.0, 0.0, 0.9, 0.0)), "unit quaternion"),
    (dataclasses.replace(target(START), quaternion=(0.0, math.sin(0.2), math.cos(0.2), 0.0)), "° from the reference"),
    (target(START, speed=0.021), "speed 0.021 is not above 0 and at most 0.02"),
    (target(START, speed=0.0), "speed 0 is not above 0"),
    (target(START, turn_speed=1.0), "turn speed 1 is not"),
    (dataclasses.replace(target(START), expires=NAN), "not finite"),
]


@pytest.mark.parametrize(("wrong", "text"), WRONG)
def test_invalid_target_is_refused_and_the_arm_holds(wrong: Target, text: str) -> None:
    robot = Robot()
    robot.step()
    robot.generator.set_target(target((0.44, 0.0, 0.30)), robot.now)
    robot.step(30)
    before = robot.sent[-1]
    robot.generator.set_target(wrong, robot.now)
    robot.step(15)
    at_rest = robot.sent[-1]
    robot.step(15)
    # The reference returns to where the robot was, not beyond, and stays there.
    assert robot.sent[-1] == at_rest
    behind = before[0][0] - at_rest[0][0]
    assert 0 <= behind <= (robot.lag + 1) * CONFIG.max_speed * CYCLE * (1 + 1e-9)
    assert at_rest[0][1:] == pytest.approx(before[0][1:], abs=1e-12)
    refusals = [event for event in robot.events() if event.startswith("refused: target refused: ")]
    assert len(refusals) == 1
    assert text in refusals[0]
    # Not latched: a valid target is followed.
    robot.generator.set_target(target((0.44, 0.0, 0.30)), robot.now)
    robot.step(30)
    assert robot.sent[-1] != before


def test_target_beyond_the_largest_step_is_refused() -> None:
    config = dataclasses.replace(CONFIG, max_step=0.002)
    now = feedback(1)
    tool, here = tool_frame(now), (START, DOWN)
    check_target(config, target((0.4019, 0.0, 0.30)), reference=here, tool=tool, feedback=now)
    with pytest.raises(SafetyError, match=r"0\.002100 m from the reference, at most 0\.002 m"):
        check_target(config, target((0.4021, 0.0, 0.30)), reference=here, tool=tool, feedback=now)


def test_target_out_of_joint_range_is_refused() -> None:
    """Near the end of joint 6 a small rotation is out of range, or a whole turn away."""
    for end, turns in ((395, "joint 6 at 43.0"), (-395, "joint 6 at -43.0")):
        joints = (*inverse(START, DOWN, near=HOME)[:5], math.radians(end))
        position, quaternion = forward(joints)
        now = EgmFeedback(1, 0.0, position, quaternion, joints)

        def check(degrees: float, joints: Joints = joints, now: EgmFeedback = now) -> None:
            position, quaternion = forward((*joints[:5], math.radians(degrees)))
            goal = dataclasses.replace(target(position), quaternion=quaternion)
            here = (now.position, now.quaternion)
            check_target(CONFIG, goal, reference=here, tool=tool_frame(now), feedback=now)

        check(end - math.copysign(8, end))
        with pytest.raises(SafetyError, match=f"target refused: within the joint ranges .* only with {turns}"):
            check(end + math.copysign(8, end))


def test_tool_frame_is_taken_into_account() -> None:
    """With a tool of 0.2 m the controller reports the tool tip; the joint angles describe the flange."""
    joints = inverse(START, DOWN, near=HOME)
    tip = (0.40, 0.0, 0.10)
    now = EgmFeedback(1, 0.0, tip, DOWN, joints)
    position, quaternion = tool_frame(now)
    assert position == pytest.approx((0.0, 0.0, 0.2), abs=1e-9)
    assert angle_between(quaternion, (1.0, 0.0, 0.0, 0.0)) < 1e-7
    config = dataclasses.replace(CONFIG, workspace_min=(-2.0, -2.0, -2.0), workspace_max=(2.0, 2.0, 2.0), max_step=3.0)
    check_target(config, target((0.41, 0.0, 0.1)), reference=(tip, DOWN), tool=tool_frame(now), feedback=now)
    with pytest.raises(SafetyError, match=r"target refused: .*out of reach"):
        check_target(config, target((0.8, 0.0, 0.1)), reference=(tip, DOWN), tool=tool_frame(now), feedback=now)


def test_pose_that_contradicts_the_joint_angles_is_refused() -> None:
    first = feedback(1)
    moved = dataclasses.replace(feedback(2), position=(0.40, 0.01, 0.30))
    text = r"10\.0 mm and 0\.0° from the forward kinematics of its joints: EGM must run in wobj0"
    with pytest.raises(SafetyError, match=text):
        check_target(CONFIG, target(START), reference=(START, DOWN), tool=tool_frame(first), feedback=moved)


@pytest.mark.parametrize(
    "changes",
    [
        {"workspace_min": (0.5, 0.0, 0.0)},
        {"port": 70000},
        {"max_speed": 0.0},
        {"max_turn": math.inf},
        {"stale": 0.2},
        {"ramp_time": -1.0},
    ],
)
def test_invalid_settings_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        dataclasses.replace(CONFIG, **changes)  # type: ignore[arg-type]


numbers = st.floats(allow_nan=True, allow_infinity=True)
near = st.floats(min_value=-0.06, max_value=0.06)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.one_of(st.tuples(near, near, near), st.tuples(numbers, numbers, numbers)),
            st.floats(min_value=-0.4, max_value=0.4),
            st.one_of(st.floats(min_value=1e-4, max_value=0.02), numbers),
            st.integers(min_value=1, max_value=40),
        ),
        max_size=12,
    )
)
def test_references_stay_within_workspace_and_speed_limits_for_arbitrary_targets(
    posts: list[tuple[tuple[float, float, float], float, float, int]],
) -> None:
    robot = Robot()
    robot.step()
    for (dx, dy, dz), turn, speed, cycles in posts:
        quaternion = (0.0, math.sin(turn / 2), math.cos(turn / 2), 0.0)
        goal = Target((0.4 + dx, dy, 0.3 + dz), quaternion, robot.now + 0.1, speed, CONFIG.max_turn_speed)
        robot.generator.set_target(goal, robot.now)
        robot.step(cycles)
    for (a, qa), (b, qb) in itertools.pairwise(robot.sent):
        assert math.dist(a, b) <= CONFIG.max_speed * CYCLE * (1 + 1e-9)
        assert angle_between(qa, qb) <= CONFIG.max_turn_speed * CYCLE * (1 + 1e-6)
        assert all(low - 1e-12 <= v <= high + 1e-12 for v, low, high in zip(b, *BOX, strict=True))


BOX = (CONFIG.workspace_min, CONFIG.workspace_max)
