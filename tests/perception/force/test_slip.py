"""Slip from forces and displacements: share that sticks, gross slip, friction stated or found, history of the load."""

from collections.abc import Iterator

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.benchmark.slip import SlippingContact, contact_states, measure_slip
from gelflow.perception.force.estimator import ForceEstimator
from gelflow.perception.force.partial_slip import PartialSlip
from gelflow.perception.force.slip import SlipEstimate, SlipEstimator
from gelflow.perception.output.forces import slip_text
from gelflow.perception.synthetic.slipping_layer import ObjectMotion, RigidObject, SlippingGel, SlippingLayer

GEL = ElasticGel(youngs_modulus=1.5e5, poisson_ratio=0.48, thickness=3e-3)
GRID = Grid(10, 13, 1.5)
VALID = np.ones(130, bool)
BALL = RigidObject("ball", 0.0, 8.0)
FRICTION = 0.5
PULL = SlippingContact(BALL, "pull", FRICTION, (0.5, -1.0), 1.0, (5.0, 4.0), 0.0, 1.0)


@pytest.fixture(scope="module")
def pulled() -> list[SlippingGel]:
    """A ball that is pressed, pulled and slips, 60 images a second."""
    return list(contact_states(PULL, GEL, GRID, 60.0))


def slips_of(states: list[SlippingGel], *, friction: float | None, deviation: float = 0.0) -> list[SlipEstimate]:
    slips, rng = SlipEstimator(GRID, friction=friction, friction_deviation=deviation), np.random.default_rng(1)
    forces = ForceEstimator(GEL, GRID)
    return list(_estimates(states, forces, slips, rng))


def _estimates(
    states: list[SlippingGel], forces: ForceEstimator, slips: SlipEstimator, rng: np.random.Generator
) -> Iterator[SlipEstimate]:
    for number, state in enumerate(states):
        moved = 1e-3 * state.displacement_mm + rng.normal(0, 1.5e-6, (130, 2))
        found = slips.estimate(forces.estimate(moved, VALID), moved, VALID, number / 60)
        assert found is not None
        yield found


def share_within(found: list[SlipEstimate], true: list[SlippingGel]) -> float:
    """Share of the images in which the share that sticks is right to 10 points."""
    shares = [np.nan if slip.stick_share is None else slip.stick_share for slip in found]
    return float(np.mean(np.abs(np.array(shares) - [state.stick_share for state in true]) <= 0.1))


def test_share_and_gross_slip_with_known_friction(pulled: list[SlippingGel]) -> None:
    found = slips_of(pulled, friction=FRICTION)
    begin = next(number for number, state in enumerate(pulled) if state.gross and number > 15)
    assert share_within(found[15:], pulled[15:]) >= 0.9
    assert not any(slip.gross for slip, true in zip(found, pulled, strict=True) if true.stick_share > 0.1)
    first = next(number for number, slip in enumerate(found) if slip.gross)
    assert begin - 2 <= first <= begin + 2  # 40 ms
    last = found[-1]
    assert last.gross and last.stick_share == 0 and last.since == first / 60 and (last.confidence or 0) > 0.6
    assert last.friction == FRICTION and not last.friction_observed


def test_unknown_friction_gives_no_share_until_it_is_observed(pulled: list[SlippingGel]) -> None:
    found = slips_of(pulled, friction=None)
    begin = next(number for number, state in enumerate(pulled) if state.gross and number > 15)
    assert all(slip.friction is None and slip.stick_share is None and not slip.gross for slip in found[: begin - 2])
    assert any(slip.gross for slip in found[begin : begin + 3])
    last = found[-1]
    assert last.friction == pytest.approx(FRICTION, rel=0.08) and last.friction_observed and last.stick_share == 0


def test_an_uncertain_friction_widens_the_deviation(pulled: list[SlippingGel]) -> None:
    middle = next(number for number, state in enumerate(pulled) if number > 15 and state.stick_share < 0.5)
    sure, unsure = (slips_of(pulled[: middle + 1], friction=FRICTION, deviation=value)[-1] for value in (0.0, 0.2))
    assert sure.stick_share_deviation is not None and unsure.stick_share_deviation is not None
    assert unsure.stick_share_deviation > 2 * sure.stick_share_deviation


def test_gross_slip_has_no_confidence_where_it_is_not_evaluated(pulled: list[SlippingGel]) -> None:
    """With an unknown friction: while the object is pressed, the shear force is small, or the normal force grows."""
    forces = ForceEstimator(GEL, GRID)
    pressed = slips_of(pulled, friction=None)[1]
    assert not pressed.gross and pressed.confidence is None
    force = forces.estimate(pulled[1].displacement_mm * 1e-3, VALID)
    assert force is not None and force.contact and slip_text(force, pressed) == "slip unknown"
    known = slips_of(pulled, friction=FRICTION)[1]
    assert known.confidence is not None and slip_text(force, known).startswith("sticks ")


def test_a_held_object_is_no_gross_slip() -> None:
    contact = SlippingContact(BALL, "hold", 0.5, (0.0, 0.0), 1.0, (6.0, 0.0), 0.0, 0.7)
    states = list(contact_states(contact, GEL, GRID, 60.0))
    for friction in (0.5, None):
        assert not any(slip.gross for slip in slips_of(states, friction=friction))
    assert share_within(slips_of(states, friction=0.5)[15:], states[15:]) >= 0.85  # the motion back included


def test_without_a_contact_nothing_slips() -> None:
    slips, forces = SlipEstimator(GRID, friction=0.5), ForceEstimator(GEL, GRID)
    rest = np.zeros((130, 2))
    slip = slips.estimate(forces.estimate(rest, VALID), rest, VALID, 0.0)
    assert slip is not None and slip.stick_share is None and not slip.gross and slip.confidence == 1.0
    assert slips.estimate(None, rest, VALID, 0.1) is None


def test_reset_forgets_an_observed_friction(pulled: list[SlippingGel]) -> None:
    slips, forces = SlipEstimator(GRID), ForceEstimator(GEL, GRID)
    *_, last = _estimates(pulled, forces, slips, np.random.default_rng(1))
    assert last.friction is not None
    slips.reset()
    rest = np.zeros((130, 2))
    after = slips.estimate(ForceEstimator(GEL, GRID).estimate(rest, VALID), rest, VALID, 0.0)
    assert after is not None and after.friction is None


def test_share_of_rising_and_falling_loads() -> None:
    """A rising load leaves (1 - T)^β; moved back from T1 to T, 1 - (T1 - T) / 2 takes the place of 1 - T."""
    state = PartialSlip(2 / 3, 0.0)
    for load in np.linspace(0, 0.8, 9):
        share = state.follow(np.array([load, 0.0, 0.0]))
        assert share == pytest.approx((1 - load) ** (2 / 3), abs=0.03)
    for load in np.linspace(0.7, 0.0, 8):
        share = state.follow(np.array([load, 0.0, 0.0]))
        assert share == pytest.approx((1 - (0.8 - load) / 2) ** (2 / 3), abs=0.03)


def test_the_model_of_a_ball_agrees_with_cattaneo_and_mindlin() -> None:
    """A pulled ball on a thick layer sticks on (1 - Q / (μ P))^(2/3) of its contact, and Q never exceeds μ P."""
    half_space = ElasticGel(1.5e5, 0.5, 0.2)
    layer = SlippingLayer(half_space, GRID, 0.4, BALL, ObjectMotion((0.0, 0.0), 0.0, 0.0))
    layer.step(ObjectMotion((0.0, 0.0), 0.0, 1.0))
    for moved in np.arange(0.04, 1.0, 0.04):
        state = layer.step(ObjectMotion((float(moved), 0.0), 0.0, 1.0))
        load = float(state.shear[0]) / 0.4
        assert state.normal == pytest.approx(1.0) and load <= 1 + 1e-9
        assert state.stick_share == pytest.approx((1 - load) ** (2 / 3), abs=0.1)
    assert state.gross and load == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_slip_from_rendered_images() -> None:
    errors = [measure_slip(name, 3, GEL, seed=2) for name in ("ellipsoid", "rounded square")]
    assert errors[0].share_within(0.1) >= 0.9
    # Flat objects stick on a larger share than stated (docs/guide/sensing/slip.md).
    assert errors[1].share_within(0.3) >= 0.9
    assert np.mean(np.concatenate([error.delays for error in errors]) <= 0.0401) >= 0.75
    assert np.mean(np.concatenate([error.alarms[:, 1] for error in errors])) < 0.02


@pytest.mark.parametrize(("friction", "deviation"), [(0.0, 0.0), (-1.0, 0.0), (0.5, 1.0), (0.5, -0.1)])
def test_wrong_friction_is_refused(friction: float, deviation: float) -> None:
    with pytest.raises(UsageError, match="friction"):
        SlipEstimator(GRID, friction=friction, friction_deviation=deviation)


def test_images_that_no_tracker_measures_are_refused() -> None:
    slips, rest = SlipEstimator(GRID), np.zeros((130, 2))
    force = ForceEstimator(GEL, GRID).estimate(rest, VALID)
    broken = rest.copy()
    broken[7, 1] = np.nan
    for displacement, valid, stamp, message in (
        (broken, VALID, 0.0, "a displacement of a valid marker is not finite"),
        (rest[:100], VALID, 0.0, r"expected displacements of shape \(130, 2\)"),
        (rest, VALID, np.nan, "stamp must be finite"),
    ):
        with pytest.raises(UsageError, match=message):
            slips.estimate(force, displacement, valid, stamp)
    broken_but_not_valid = VALID.copy()
    broken_but_not_valid[7] = False
    assert slips.estimate(force, broken, broken_but_not_valid, 0.0) is not None
