"""Calibration of a gel: modulus, lag, thickness, and wrong tables."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gelflow.errors import UsageError
from gelflow.gel.creep import deformation
from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.force.estimator import ForceEstimator
from gelflow.perception.force.gel_fit import ForceSamples, fit_gel, read_samples
from gelflow.perception.output.forces import ForceTable
from gelflow.perception.synthetic.pressed_layer import SHAPES, PressedLayer, random_press

TRUE = ElasticGel(youngs_modulus=2.1e5, poisson_ratio=0.48, thickness=3e-3)
GUESS = replace(TRUE, youngs_modulus=1.5e5)
GRID = Grid(10, 13, 1.5)
VALID = np.ones(130, bool)
RATE = 50.0


@pytest.fixture(scope="module")
def layer() -> PressedLayer:
    return PressedLayer(TRUE, GRID)


def record(
    layer: PressedLayer, folder: Path, *, gel: ElasticGel = GUESS, creep: float = 0.0, seed: int = 0
) -> tuple[Path, Path]:
    """Five objects are pressed on and lifted; tables of the estimates with `gel` and of a scale at 50 Hz."""
    rng = np.random.default_rng(seed)
    share = np.concatenate([np.linspace(0, 1, 4), np.ones(10), np.linspace(1, 0, 3), np.zeros(6)])
    stamps, rows = np.arange(5 * len(share)) / RATE, []
    for shape in SHAPES:
        rows += [(layer.press(random_press(shape, GRID, rng, normal=(1.0, 5.0))), part) for part in [1.0]]
    estimator, table = ForceEstimator(gel, GRID), ForceTable(folder / "a.forces.csv")
    lines = ["stamp,normal_n,shear_n"]
    lagging = np.concatenate([deformation(share, stamps[: len(share)], creep, 0.1)] * 5)
    for number, stamp in enumerate(stamps):
        true, part = rows[number // len(share)][0], share[number % len(share)]
        moved = 1e-3 * lagging[number] * true.displacement_mm + rng.normal(0, 1.5e-6, (130, 2))
        table.add(number, f"{number}.jpg", stamp, estimator.estimate(moved, VALID))
        lines.append(f"{stamp},{part * true.normal},{part * np.linalg.norm(true.shear)}")
    table.close()
    (folder / "scale.csv").write_text("\n".join(lines))
    return folder / "a.forces.csv", folder / "scale.csv"


@pytest.mark.parametrize("seed", range(3))
def test_modulus_from_a_scale(layer: PressedLayer, tmp_path: Path, seed: int) -> None:
    fit = fit_gel(read_samples(*record(layer, tmp_path, seed=seed)), GUESS)
    assert fit.contacts == 5 and fit.thickness is None and fit.creep_deviation is None and not fit.doubtful
    error = abs(fit.gel.youngs_modulus / TRUE.youngs_modulus - 1)
    assert error < 0.04
    assert error < 2.5 * fit.gel.youngs_modulus_deviation < 0.1
    assert fit.normal is not None and fit.normal.value == pytest.approx(1.4, rel=0.08)
    assert 0.2 < fit.largest_ratio < 0.9


def test_lag_from_a_scale(layer: PressedLayer, tmp_path: Path) -> None:
    fit = fit_gel(read_samples(*record(layer, tmp_path, creep=0.25)), GUESS)
    assert fit.creep_deviation is not None
    assert fit.gel.creep == pytest.approx(0.25, abs=0.08)
    assert fit.gel.creep_time == pytest.approx(0.1, rel=0.5)
    assert fit.gel.youngs_modulus == pytest.approx(TRUE.youngs_modulus, rel=0.04)


def test_modulus_from_known_weights(layer: PressedLayer, tmp_path: Path) -> None:
    estimates, _ = record(layer, tmp_path)
    rng = np.random.default_rng(0)
    weights = [layer.press(random_press(shape, GRID, rng, normal=(1.0, 5.0))).normal for shape in SHAPES]
    (tmp_path / "weights.csv").write_text(
        "image,normal_n\n" + "\n".join(f"{23 * k + 10}.jpg,{weight}" for k, weight in enumerate(weights))
    )
    fit = fit_gel(read_samples(estimates, tmp_path / "weights.csv"), GUESS)
    assert fit.contacts == 5 and fit.shear is None
    assert fit.gel.youngs_modulus == pytest.approx(TRUE.youngs_modulus, rel=0.08)


def without_estimates(table: Path, numbers: Iterable[int]) -> None:
    """Empty the cells of some images, as where too few markers are measured."""
    head, *rows = (line.split(",") for line in table.read_text().splitlines())
    for number in numbers:
        rows[number][3:] = [""] * len(rows[number][3:])
    table.write_text("\n".join(map(",".join, [head, *rows])))


def test_images_of_one_contact_share_their_error(layer: PressedLayer, tmp_path: Path) -> None:
    estimates, scale = record(layer, tmp_path)
    forces = [line.split(",")[1] for line in scale.read_text().splitlines()[1:]]
    scale.write_text("image,normal_n\n" + "\n".join(f"{k}.jpg,{force}" for k, force in enumerate(forces)))
    fit = fit_gel(read_samples(estimates, scale), GUESS)
    assert fit.contacts == 5
    assert fit.gel.youngs_modulus_deviation > 0.026  # 6 % / sqrt(5)


@pytest.mark.parametrize("by_image", [False, True])
def test_an_image_without_an_estimate_does_not_end_a_contact(
    layer: PressedLayer, tmp_path: Path, by_image: bool
) -> None:
    estimates, scale = record(layer, tmp_path)
    if by_image:
        scale.write_text("image,normal_n\n" + "\n".join(f"{k}.jpg,2" for k in range(115)))
    without_estimates(estimates, [8, 31])
    samples = read_samples(estimates, scale)
    assert len(np.unique(samples.contact)) == 5 and samples.started.all()


def test_a_contact_starts_where_the_image_before_was_measured_without_one(layer: PressedLayer, tmp_path: Path) -> None:
    """The first contact is measured from its middle on; the second has no estimates at its start."""
    estimates, scale = record(layer, tmp_path)
    head, *rows = scale.read_text().splitlines()
    scale.write_text("\n".join([head, *rows[8:]]))
    without_estimates(estimates, range(20, 31))
    samples = read_samples(estimates, scale)
    started = [samples.started[samples.contact == number].tolist() for number in range(5)]
    assert [any(of_contact) for of_contact in started] == [False, False, True, True, True]
    assert [all(of_contact) for of_contact in started] == [False, False, True, True, True]


def test_contacts_whose_start_was_not_seen_do_not_change_the_lag() -> None:
    """Their force is constant, and the gel has followed it before the first image."""
    stamps = np.arange(50) / RATE
    forces = [np.minimum(1.0, (stamps + 0.02) / 0.06) * force for force in (1.0, 2.0, 3.0)]
    lagging = [deformation(np.append(0.0, force), np.append(-0.02, stamps), 0.25, 0.1)[1:] for force in forces]
    constant = [np.full(50, 4.0), np.full(50, 5.0)]
    normal = np.concatenate(lagging + constant) / 1.4
    samples = ForceSamples(
        stamp=np.concatenate([stamps + 10 * number for number in range(5)]),
        contact=np.repeat(np.arange(5), 50),
        started=np.repeat([True, True, True, False, False], 50),
        normal=normal,
        shear=0.2 * normal,
        measured_normal=np.concatenate(forces + constant),
        measured_shear=np.full(250, np.nan),
        in_time=True,
    )
    fit = fit_gel(samples, GUESS)
    assert fit.gel.creep == pytest.approx(0.25, abs=0.01)
    assert fit.gel.creep_time == pytest.approx(0.1, rel=0.05)
    assert fit.gel.youngs_modulus == pytest.approx(1.4 * GUESS.youngs_modulus, rel=1e-3)


def test_a_table_with_times_and_images_is_refused(layer: PressedLayer, tmp_path: Path) -> None:
    estimates, scale = record(layer, tmp_path)
    scale.write_text("image,stamp,normal_n\n" + "\n".join(f"{k}.jpg,{0.1 * k},2" for k in range(6)))
    with pytest.raises(UsageError, match="has the columns stamp and image; give one"):
        read_samples(estimates, scale)


def test_times_in_milliseconds_are_refused(layer: PressedLayer, tmp_path: Path) -> None:
    estimates, scale = record(layer, tmp_path)
    head, *rows = (line.split(",") for line in scale.read_text().splitlines())
    in_milliseconds = [[f"{1e3 * float(stamp)}", *forces] for stamp, *forces in rows]
    scale.write_text("\n".join(map(",".join, [head, *in_milliseconds])))
    with pytest.raises(UsageError, match=r"of 115 rows .* stamp must be in seconds"):
        read_samples(estimates, scale)


def test_a_table_may_be_longer_than_the_images(layer: PressedLayer, tmp_path: Path) -> None:
    """Two rows a second for 200 s; the images take 2.3 s."""
    estimates, scale = record(layer, tmp_path)
    images = len(read_samples(estimates, scale).stamp)
    scale.write_text("stamp,normal_n\n" + "\n".join(f"{0.5 * k},2" for k in range(-200, 200)))
    assert len(read_samples(estimates, scale).stamp) == images


def test_a_wrong_thickness_shows(layer: PressedLayer, tmp_path: Path) -> None:
    wrong = replace(GUESS, thickness=4.5e-3)
    fit = fit_gel(read_samples(*record(layer, tmp_path, gel=wrong)), wrong)
    assert fit.thickness is not None
    assert fit.thickness < 4e-3
    assert fit.gel.youngs_modulus_deviation > 0.1
    assert fit.creep_deviation is None  # the gel has none: a lag that is longer than the contacts is not measured
    assert abs(fit.gel.youngs_modulus / TRUE.youngs_modulus - 1) < 2 * fit.gel.youngs_modulus_deviation


@pytest.mark.parametrize("thickness", [2e-3, 3.6e-3, 4.5e-3])
def test_contacts_that_disagree_make_the_thickness_doubtful(
    layer: PressedLayer, tmp_path: Path, thickness: float
) -> None:
    """Where both factors agree by chance, the scatter of the contacts shows the wrong thickness."""
    wrong = replace(GUESS, thickness=thickness)
    for seed in range(4):
        (folder := tmp_path / str(seed)).mkdir()
        fit = fit_gel(read_samples(*record(layer, folder, gel=wrong, seed=seed)), wrong)
        assert fit.doubtful or fit.thickness is not None
        assert abs(fit.gel.youngs_modulus / TRUE.youngs_modulus - 1) < 3 * fit.gel.youngs_modulus_deviation


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("stamp,weight\n0,1\n", "normal_n"),
        ("image,normal_n\n", "no rows"),
        ("image,normal_n\nx.jpg,1\n", "agree"),
        ("stamp,normal_n\n0,1\n0,2\n", "increase"),
        ("stamp,normal_n\n0,one\n", "number"),
        ("stamp,normal_n\n0,0\n9,0\n", "above 0"),
        ("stamp,normal_n\n0,-2\n9,-2\n", "normal_n is negative during contact"),
        ("stamp,normal_n\n0,1\n9,5,3\n", "row 2 has more cells"),
        ("stamp,normal_n,normal_n\n0,1,5\n9,2,5\n", "has the column normal_n twice"),
        ("image,normal_n\n10.jpg,1\n10.jpg,2\n", "normal_n of 10.jpg is there twice"),
        ("normal_n,image\n1,9.jpg\n2\n2\n", "row 2 has no image"),
        ("image,normal_n\n,1\n9.jpg,2\n", "row 1 has no image"),
        ("stamp,normal_n\n0,1e300\n9,1e300\n", "normal_n is 1e.300; forces are in newtons"),
        ("stamp,normal_n\n0,1e-300\n9,1e-300\n", "times the estimates; are they in newtons"),
    ],
)
def test_wrong_measurements_are_refused(layer: PressedLayer, tmp_path: Path, text: str, named: str) -> None:
    estimates, scale = record(layer, tmp_path)
    scale.write_text(text)
    with pytest.raises(UsageError, match=named):
        fit_gel(read_samples(estimates, scale), GUESS)


def test_tables_of_a_spreadsheet_are_read(layer: PressedLayer, tmp_path: Path) -> None:
    """With a byte-order mark, and an empty cell at the end of a row."""
    estimates, scale = record(layer, tmp_path)
    expected = read_samples(estimates, scale)
    scale.write_text("\n".join(f"{line}," for line in scale.read_text().splitlines()), encoding="utf-8-sig")
    estimates.write_text(estimates.read_text(), encoding="utf-8-sig")
    np.testing.assert_array_equal(read_samples(estimates, scale).measured_normal, expected.measured_normal)
    scale.write_text("stamp,normal_n\n0,1,\n9,5,\n")
    assert len(read_samples(estimates, scale).stamp) == len(expected.stamp)


def test_estimates_whose_time_jumps_back_are_refused(layer: PressedLayer, tmp_path: Path) -> None:
    estimates, scale = record(layer, tmp_path)
    head, *rows = estimates.read_text().splitlines()
    estimates.write_text("\n".join([head, *rows[60:], *rows[:60]]))
    with pytest.raises(UsageError, match=r"a\.forces\.csv: stamps must not decrease"):
        read_samples(estimates, scale)


def test_estimates_without_normal_forces_are_refused(layer: PressedLayer, tmp_path: Path) -> None:
    samples = read_samples(*record(layer, tmp_path))
    unknown = np.full_like(samples.measured_normal, np.nan)
    with pytest.raises(UsageError, match="normal force of every image with contact is 0: press harder"):
        fit_gel(replace(samples, normal=0 * samples.normal, measured_normal=unknown), GUESS)


def test_estimates_with_a_lag_are_refused(layer: PressedLayer, tmp_path: Path) -> None:
    samples = read_samples(*record(layer, tmp_path))
    with pytest.raises(UsageError, match="creep"):
        fit_gel(samples, replace(GUESS, creep=0.1))
