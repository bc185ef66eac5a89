"""Randomization tables, and the sensor model whose levels they set."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.observation import Grid, TactileFrame, fill_invalid
from gelflow.sim.tasks.insertion_randomization import DEFAULT_RANDOMIZATION, FULL_RANDOMIZATION, NOMINAL
from gelflow.sim.tasks.randomization import Fixed, LogUniform, Normal, Quantity, Randomization, Uniform
from gelflow.sim.tasks.sensor_model import NO_SENSOR_EFFECTS, PAIR_QUANTITIES, SENSOR_QUANTITIES, SensorModel

GRID = Grid(13, 10, 1.5)
ALL = np.ones(3, dtype=bool)


# Without equal distances, so that the nearest markers are unique.
SCATTERED = GRID.positions() + np.random.default_rng(9).uniform(-0.3, 0.3, (130, 2))


def pads(positions: Any = None, **levels: float) -> tuple[SensorModel, Any]:
    """A sensor model of three environments with two pads, and its generator; unset levels are 0."""
    model = SensorModel([GRID.positions() if positions is None else positions] * 2, 3)
    rng = np.random.default_rng(3)
    table = Randomization(NO_SENSOR_EFFECTS).replace(**levels)
    model.draw(ALL, table.sample(rng, 3, friction="elastic"), rng)
    return model, rng


def test_samples_follow_their_distributions() -> None:
    rng = np.random.default_rng(0)
    assert Uniform(1, 3).sample(rng, 4000).mean() == pytest.approx(2, abs=0.05)
    logs = np.log10(LogUniform(0.01, 100).sample(rng, 4000))
    assert logs.min() > -2 and logs.max() < 2 and np.mean(logs) == pytest.approx(0, abs=0.1)
    normal = Normal(1, 2).sample(rng, 4000)
    assert (normal.mean(), normal.std()) == (pytest.approx(1, abs=0.1), pytest.approx(2, rel=0.05))
    assert (Fixed(4).sample(rng, 3) == 4).all()


def test_friction_law_selects_quantities() -> None:
    rng = np.random.default_rng(0)
    elastic = DEFAULT_RANDOMIZATION.sample(rng, 2, friction="elastic")
    viscous = DEFAULT_RANDOMIZATION.sample(rng, 2, friction="viscous")
    assert set(elastic) - set(viscous) == {"pad_ks", "marker_ks"}
    assert set(viscous) - set(elastic) == {"pad_kt", "marker_kt"}


def test_fixing_one_quantity_leaves_the_samples_of_the_others() -> None:
    def sample(table: Randomization) -> dict[str, Any]:
        return table.sample(np.random.default_rng(0), 5, friction="elastic")

    before, after = sample(DEFAULT_RANDOMIZATION), sample(DEFAULT_RANDOMIZATION.replace(pad_mu=1.0, noise=(1e-4, 2e-4)))
    assert (after["pad_mu"] == 1).all() and (after["noise"] >= 1e-4).all()
    for name in set(before) - {"pad_mu", "noise"}:
        np.testing.assert_array_equal(before[name], after[name])


def test_quantities_with_samples_are_drawn_together() -> None:
    table = DEFAULT_RANDOMIZATION.drawn_from({"pad_mu": [1.0, 2.0, 3.0], "pad_kn": [4e3, 5e3, 6e3]})
    drawn = table.sample(np.random.default_rng(0), 200, friction="elastic")
    np.testing.assert_allclose(drawn["pad_kn"], 1e3 * (drawn["pad_mu"] + 3))
    assert set(drawn["pad_mu"]) == {1.0, 2.0, 3.0} and len(set(drawn["hole_kn"])) == 200
    fixed = table.replace(pad_mu=1.5).sample(np.random.default_rng(0), 20, friction="elastic")
    assert (fixed["pad_mu"] == 1.5).all() and set(fixed["pad_kn"]) <= {4e3, 5e3, 6e3}
    described = {row["quantity"]: row for row in table.rows()}
    assert (described["pad_mu"]["low"], described["pad_mu"]["high"]) == (1.0, 3.0)
    assert described["hole_kn"] == {row["quantity"]: row for row in DEFAULT_RANDOMIZATION.rows()}["hole_kn"]


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ({"pad_my": [1.0]}, "no quantity 'pad_my'; did you mean 'pad_mu'"),
        ({"pad_mu": [1.0, np.nan]}, "pad_mu: samples must be finite numbers"),
        ({"pad_mu": 1.0}, "pad_mu: samples must be finite numbers, got 1.0"),
        ({"pad_mu": ["a"]}, "pad_mu: samples must be finite numbers"),
        ({"pad_mu": [1.0], "pad_kn": [1.0, 2.0]}, "equally many samples"),
    ],
)
def test_bad_samples_are_named(samples: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        DEFAULT_RANDOMIZATION.drawn_from(samples)


def test_bad_tables_are_named() -> None:
    with pytest.raises(UsageError, match="no quantity 'pad_my'; did you mean 'pad_mu'"):
        NOMINAL.replace(pad_my=1.0)
    with pytest.raises(UsageError, match=r"randomization: pad_mu: .* low ≤ high, got \(2.0, 1.0\)"):
        NOMINAL.replace(pad_mu=(2.0, 1.0))
    with pytest.raises(UsageError, match="hole_kn: a logarithmic range must be positive"):
        NOMINAL.replace(hole_kn=(0.0, 1.0))
    for value in ("soft", (1.0, 2.0, 3.0), np.nan):
        with pytest.raises(UsageError, match="pad_mu: expected a number, a pair"):
            NOMINAL.replace(pad_mu=value)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Uniform("a", 1), "low must be a number, got 'a'"),  # type: ignore[arg-type]
        (lambda: Normal("a", 1), "mean must be a number, got 'a'"),  # type: ignore[arg-type]
        (lambda: Normal(0.08, -0.01), r"a normal distribution needs a finite mean and std ≥ 0, got \(0.08, -0.01\)"),
        (lambda: Normal(np.nan, 0.01), "a normal distribution needs a finite mean"),
        (lambda: Fixed("a"), "value must be a number, got 'a'"),  # type: ignore[arg-type]
        (lambda: Fixed(np.inf), "a fixed value must be finite, got inf"),
    ],
)
def test_impossible_distributions_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()


def test_rows_describe_the_table() -> None:
    table = Randomization({"mass": Quantity(Uniform(1, 2), "kg", "of the bar")})
    assert table.rows() == [
        {
            "quantity": "mass",
            "distribution": "Uniform",
            "low": 1,
            "high": 2,
            "unit": "kg",
            "friction": None,
            "meaning": "of the bar",
        }
    ]


def test_sensor_without_effects_reads_the_forces_and_uses_no_random_number() -> None:
    model, rng = pads()
    state = rng.bit_generator.state
    forces = np.random.default_rng(1).normal(size=(3, 260, 2))
    for interval in (0.0, 0.1):
        np.testing.assert_array_equal(model.read(forces, ALL, rng, interval=interval), forces)
    assert rng.bit_generator.state == state


def test_lag_of_the_gel_follows_the_linear_solid() -> None:
    """A ramp of slope r, from rest: the delayed part is r (t − τ + τ e^(−t/τ)), also when it is read in parts."""
    creep, tau, slope, time = 0.3, 0.2, 2.0, 0.5
    expected = slope * ((1 - creep) * time + creep * (time - tau * (1 - np.exp(-time / tau))))
    for parts in (1, 5):
        model, rng = pads(gel_creep=creep, gel_time=tau)
        assert not model.read(np.zeros((3, 260, 2)), ALL, rng, interval=1.0).any()
        for t in np.linspace(0, time, parts + 1)[1:]:
            reading = model.read(np.full((3, 260, 2), slope * t), ALL, rng, interval=time / parts)
        np.testing.assert_allclose(reading, expected, rtol=1e-12)
    model.clear(ALL)
    np.testing.assert_array_equal(model.read(np.full((3, 260, 2), 7.0), ALL, rng, interval=0.01), 7.0)
    held = model.read(np.full((1, 260, 2), 1.0), np.array([True, False, False]), rng, interval=1e-9)
    np.testing.assert_allclose(held, 0.7 + 0.3 * 7, rtol=1e-6)


def test_crosstalk_moves_force_to_the_neighbours_and_keeps_a_uniform_field() -> None:
    model, rng = pads(crosstalk=0.2)
    np.testing.assert_allclose(model.read(np.ones((3, 260, 2)), ALL, rng, interval=0), 1)
    single = np.zeros((3, 260, 2))
    single[:, 65] = 1  # inside the first pad: row 6, column 5
    reading = model.read(single, ALL, rng, interval=0)[0, :130, 0].reshape(13, 10)
    assert reading[6, 5] == pytest.approx(0.8)
    np.testing.assert_allclose([reading[5, 5], reading[7, 5], reading[6, 4], reading[6, 6]], 0.05)
    assert reading.sum() == pytest.approx(1)


def test_dead_markers_are_filled_like_those_of_a_camera() -> None:
    model, rng = pads(SCATTERED, dead_markers=0.05)
    forces = np.random.default_rng(1).normal(size=(3, 260, 2))
    reading = model.read(forces, ALL, rng, interval=0)
    dead = (reading != forces).any(2)
    assert 15 < dead.sum() < 70
    for env in range(3):
        valid = ~dead[env].reshape(2, 130)
        shear = np.where(valid[..., None], forces[env].reshape(2, 130, 2), np.nan).astype(np.float32)
        frame = TactileFrame(shear, valid, SCATTERED.astype(np.float32), 0.0, "N")
        np.testing.assert_allclose(fill_invalid(frame).reshape(260, 2), reading[env], atol=1e-5)


def test_gain_turn_drift_and_noise_of_pads() -> None:
    ones = np.ones((3, 260, 2))
    model, rng = pads(pad_gain=0.1)
    gain = model.read(ones, ALL, rng, interval=0)
    assert len(np.unique(gain)) == 6 and np.abs(np.log(gain)).max() < 0.5  # one per pad and environment
    model, rng = pads(pad_turn=0.1)
    turned = model.read(ones, ALL, rng, interval=0)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=2), np.sqrt(2))
    assert len(np.unique(np.round(turned[..., 0], 12))) == 6
    model, rng = pads(pad_drift=0.1)
    drift = [model.read(ones, ALL, rng, interval=0) - 1 for _ in range(2)]
    assert len(np.unique(np.round(drift[0], 12))) == 12 and (drift[0] != drift[1]).all()
    model, rng = pads(noise=0.1, noisy_markers=0.2)
    noise = np.concatenate([model.read(ones, ALL, rng, interval=0) - 1 for _ in range(100)], axis=2).std(2)
    noisy = noise > 0.4
    assert noisy.mean() == pytest.approx(0.2, abs=0.06)
    np.testing.assert_allclose(noise[~noisy], 0.1, rtol=0.35)
    np.testing.assert_allclose(noise[noisy], 1.0, rtol=0.35)


def test_known_differences_of_two_pads() -> None:
    model, rng = SensorModel([GRID.positions()] * 2, 3), np.random.default_rng(0)
    table = Randomization({**NO_SENSOR_EFFECTS, **PAIR_QUANTITIES})
    model.draw(ALL, table.sample(rng, 3, friction="elastic"), rng)
    assert model.ideal
    different = table.replace(gain_ratio=2.25, turn_left=np.pi / 2, turn_right=-np.pi / 2)
    model.draw(ALL, different.sample(rng, 3, friction="elastic"), rng)
    assert not model.ideal
    forces = np.zeros((3, 260, 2))
    forces[..., 0] = 3.0
    left, right = np.split(model.read(forces, ALL, rng, interval=0), 2, axis=1)
    np.testing.assert_allclose(left, np.broadcast_to([0.0, 2.0], left.shape), atol=1e-12)
    np.testing.assert_allclose(right, np.broadcast_to([0.0, -4.5], right.shape), atol=1e-12)


def test_full_randomization_contains_all_effects() -> None:
    assert set(SENSOR_QUANTITIES) <= set(FULL_RANDOMIZATION)
    model = SensorModel([GRID.positions(), GRID.positions()], 3)
    rng = np.random.default_rng(0)
    model.draw(ALL, FULL_RANDOMIZATION.sample(rng, 3, friction="elastic"), rng)
    one = np.array([False, True, False])
    reading = model.read(np.ones((1, 260, 2)), one, rng, interval=0)
    assert reading.shape == (1, 260, 2) and np.isfinite(reading).all() and (reading != 1).mean() > 0.9


def test_pads_with_few_markers() -> None:
    model = SensorModel([np.zeros((1, 3)), np.eye(3)], 1)
    rng, one = np.random.default_rng(0), np.ones(1, dtype=bool)
    levels = {name: np.full(1, 0.5) for name in SENSOR_QUANTITIES}
    model.draw(one, levels, rng)
    assert np.isfinite(model.read(np.ones((1, 4, 3)), one, rng, interval=0.1)).all()
