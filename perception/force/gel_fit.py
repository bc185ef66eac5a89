"""Stiffness and lag of a gel from forces that were measured while its markers were tracked.

Estimated forces are proportional to Young's modulus, so the factor between measured and estimated forces corrects it.
Shear forces vary with modulus / thickness, normal forces with modulus / thickness²: where both were measured and their
factors differ, the stated thickness is wrong.
"""

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.gel.creep import deformation
from gelflow.gel.gel_file import ElasticGel

Array = NDArray[np.float64]

# Error of one contact that more images of it do not reduce, relative; see docs/guide/sensing/forces.md.
_CONTACT_ERROR = {"normal": 0.06, "shear": 0.015}
# Scatter of the normal factors above which the thickness is doubtful: in 12 calibrations from five contacts each it is
# .01 to .05 with the right thickness, and .05 to .5 (all but one above .08) with one that is wrong by half.
_DOUBTFUL_SCATTER = 0.08
_DOUBT = 2.0  # deviation of the modulus / scatter, where the thickness is doubtful
_SMALLEST = 0.1  # share of the largest measured force below which an image is not used
_LARGEST_FORCE = 1e5  # measured force [N]: larger ones have another unit
_LARGEST_FACTOR = 1000.0  # measured / estimated force, or estimated / measured
_FEWEST = 3  # images with contact and measured force
_LAG_ERROR = 0.05  # of the modulus, relative to the creep
_LAG_IMAGES = 30  # fewer do not determine a lag
_LAG_EVIDENCE = 10.0  # by which the Bayesian information criterion must improve
# A table of at least so many rows has another unit of time than seconds if it is so many times longer than the images
# and has less than this share of rows for each image with contact.
_UNIT_ROWS, _UNIT_SPAN, _UNIT_SHARE = 10, 50.0, 0.02


@dataclass(frozen=True)
class ForceSamples:
    """Estimated and measured forces of images with contact [N]; NaN where not measured."""

    stamp: Array  # [s], shape (n,)
    contact: NDArray[np.intp]  # number of the contact that an image belongs to, shape (n,)
    started: NDArray[np.bool_]  # the image before its contact was measured, without a contact; shape (n,)
    normal: Array  # estimated, shape (n,)
    shear: Array
    measured_normal: Array
    measured_shear: Array
    in_time: bool  # measured as a function of time, not at single images


@dataclass(frozen=True)
class Factor:
    """Measured / estimated force, with its standard deviation."""

    value: float
    deviation: float
    scatter: float | None  # standard deviation of the factors of single contacts / value; None for one contact


@dataclass(frozen=True)
class GelFit:
    """A fitted gel."""

    gel: ElasticGel
    normal: Factor | None  # None where it was not measured
    shear: Factor | None
    contacts: int
    largest_ratio: float  # of shear to normal force: a lower limit of the friction
    thickness: float | None  # with which both factors would agree [m]; None where they do
    creep_deviation: float | None  # None without a fitted lag

    @property
    def doubtful(self) -> bool:
        """Whether the normal forces of the contacts scatter as with a wrong thickness."""
        return _scatter(self.normal) > _DOUBTFUL_SCATTER


def read_samples(estimates: Path, measured: Path) -> ForceSamples:
    """Images of a `.forces.csv` of `gelflow track`, with the forces of a table of measurements.

    The table has the column `stamp` [s] (forces between two rows are interpolated) or `image` (name as in the
    estimates), and `normal_n`, `shear_n` or both. Raises UsageError for other tables and where nothing matches.
    """
    rows = _read(estimates, ("image", "stamp", "contact", "normal_n", "shear_right_n", "shear_down_n"))
    table = _read(measured, ())
    columns = set(table[0])
    if not columns & {"normal_n", "shear_n"} or not columns & {"stamp", "image"}:
        raise UsageError(
            f"{measured} needs the column stamp or image, and normal_n or shear_n [N]; it has {', '.join(columns)}"
        )
    if {"stamp", "image"} <= columns:
        raise UsageError(
            f"{measured} has the columns stamp and image; give one: image for forces that were measured in these "
            "images, stamp for forces between whose rows is interpolated"
        )
    in_time = "stamp" in columns
    known = [_measurements(table, name, measured, in_time=in_time) for name in ("normal_n", "shear_n")]
    if in_time:
        _check_times(rows, known, estimates, measured)
    data = _contact_rows(rows, known, estimates)
    data = data[np.isfinite(data[:, 5:]).any(1)]
    for name, forces in (("normal_n", data[:, 5]), ("shear_n", data[:, 6])):
        if (largest := np.nanmax(np.abs(forces), initial=0.0)) > _LARGEST_FORCE:
            raise UsageError(f"{measured}: {name} is {largest:.3g}; forces are in newtons")
        if np.nansum(forces) < 0:
            raise UsageError(f"{measured}: {name} is negative during contact; forces count positive: change its sign")
    if len(data) < _FEWEST:
        raise UsageError(
            f"{len(data)} images have both a contact and a measured force; at least {_FEWEST} are needed: do stamps or "
            "image names of both tables agree?"
        )
    return ForceSamples(
        stamp=data[:, 0],
        contact=data[:, 1].astype(np.intp),
        started=data[:, 2].astype(bool),
        normal=data[:, 3],
        shear=data[:, 4],
        measured_normal=data[:, 5],
        measured_shear=data[:, 6],
        in_time=in_time,
    )


def _check_times(rows: list[dict[str, str]], known: "list[_Measurements]", estimates: Path, measured: Path) -> None:
    """Raise UsageError where the stamps of images decrease, or those of measurements are not in seconds."""
    stamps = np.array([_number(row, "stamp", estimates) for row in rows])
    if (np.diff(stamps) < 0).any():
        raise UsageError(f"{estimates}: stamps must not decrease: track one recording without a jump of its time")
    touched = stamps[np.array([row["contact"] == "1" for row in rows])]
    for times in (part.stamps for part in known):
        if times is None or len(times) < _UNIT_ROWS or not len(touched):
            continue
        used = int(((times >= touched[0]) & (times <= touched[-1])).sum())
        if np.ptp(times) > _UNIT_SPAN * np.ptp(stamps) and used < max(2.0, _UNIT_SHARE * len(touched)):
            raise UsageError(
                f"{measured}: {used} of {len(times)} rows are between the first and the last image with contact "
                f"({touched[0]:g} to {touched[-1]:g} s): stamp must be in seconds"
            )


def _contact_rows(rows: list[dict[str, str]], known: "list[_Measurements]", path: Path) -> Array:
    """One row per image with contact, shape (n, 7): stamp, number of the contact, whether its start was seen,
    estimated normal and shear force, measured normal and shear force.

    A contact lasts until an image without one. An image without an estimate does not end it.
    """
    kept: list[tuple[float, ...]] = []
    contact, touching, started = -1, False, False
    free = False  # the image before was measured and without a contact
    for row in rows:
        if not row["contact"]:
            free = False
            continue
        stamp = _number(row, "stamp", path)
        values = [part(stamp, row["image"]) for part in known]
        if row["contact"] != "1":
            touching = False
            free = all(math.isfinite(value) for value, part in zip(values, known, strict=True) if len(part.values))
            continue
        if not touching:
            contact, touching, started = contact + 1, True, free
        shear = math.hypot(_number(row, "shear_right_n", path), _number(row, "shear_down_n", path))
        kept.append((stamp, contact, started, _number(row, "normal_n", path), shear, *values))
    return np.array(kept, dtype=float).reshape(-1, 7)


def fit_gel(samples: ForceSamples, gel: ElasticGel) -> GelFit:
    """The gel with which the estimated forces equal the measured ones; `gel` is that of the estimates.

    Raises UsageError where the estimates already contain a lag, or nothing was pressed.
    """
    if gel.creep:
        raise UsageError("the gel of the estimates has a creep: track with a gel file without it, then fit again")
    if not (samples.normal > 0).any():
        raise UsageError("the estimated normal force of every image with contact is 0: press harder")
    creep, creep_time, creep_deviation = _lag(samples)
    normal = _factor(samples, samples.normal, _lagging(samples, samples.measured_normal, creep, creep_time), "normal")
    shear = _factor(samples, samples.shear, _lagging(samples, samples.measured_shear, creep, creep_time), "shear")
    found = [factor for factor in (normal, shear) if factor is not None]
    if not found:
        raise UsageError("no image has a measured and an estimated force above 0: press harder, or check the units (N)")
    for factor in found:
        if not 1 / _LARGEST_FACTOR < factor.value < _LARGEST_FACTOR:
            raise UsageError(
                f"measured forces are {factor.value:.3g} times the estimates; are they in newtons, the modulus in Pa?"
            )
    weights = np.array([factor.deviation for factor in found]) ** -2.0
    scale = float(weights @ [factor.value for factor in found] / weights.sum())
    deviation = math.hypot(float(weights.sum() ** -0.5) / scale, _LAG_ERROR * creep)
    thickness = None
    if normal and shear and abs(normal.value - shear.value) > 2 * math.hypot(normal.deviation, shear.deviation):
        thickness = gel.thickness * shear.value / normal.value
        # Both factors depend on the thickness, so their mean may be wrong by as much as they differ.
        deviation = max(deviation, abs(normal.value / shear.value - 1))
    if _scatter(normal) > _DOUBTFUL_SCATTER:
        deviation = max(deviation, _DOUBT * _scatter(normal))
    pressed = samples.normal > 0.2 * samples.normal.max()
    return GelFit(
        gel=replace(
            gel,
            youngs_modulus=gel.youngs_modulus * scale,
            youngs_modulus_deviation=min(deviation, 0.99),
            creep=creep,
            creep_time=creep_time,
        ),
        normal=normal,
        shear=shear,
        contacts=len(np.unique(samples.contact)),
        largest_ratio=float((samples.shear[pressed] / samples.normal[pressed]).max()),
        thickness=thickness,
        creep_deviation=creep_deviation,
    )


def _factor(samples: ForceSamples, estimated: Array, measured: Array, kind: str) -> Factor | None:
    """The factor of one component by least squares; its deviation by leaving out one contact at a time."""
    largest = np.nanmax(measured, initial=0.0, where=np.isfinite(measured))
    used = np.isfinite(measured) & (measured > _SMALLEST * largest) & (estimated > 0)
    if not used.any():
        return None
    group, estimated, measured = samples.contact[used], estimated[used], measured[used]
    contacts = np.unique(group)
    products = np.array([(estimated[group == c] * measured[group == c]).sum() for c in contacts])
    squares = np.array([(estimated[group == c] ** 2).sum() for c in contacts])
    value = float(products.sum() / squares.sum())
    count = len(contacts)
    spread, scatter = 0.0, None
    if count > 1:
        others = (products.sum() - products) / (squares.sum() - squares)
        spread = float(np.sqrt((count - 1) / count * ((others - others.mean()) ** 2).sum()))
        variance = squares @ (products / squares / value - 1) ** 2 / squares.sum()
        scatter = math.sqrt(float(variance) * count / (count - 1))
    return Factor(value, math.hypot(spread, _CONTACT_ERROR[kind] * value / math.sqrt(count)), scatter)


def _scatter(factor: Factor | None) -> float:
    """0 where it is not known."""
    return 0.0 if factor is None or factor.scatter is None else factor.scatter


def _lag(samples: ForceSamples) -> tuple[float, float, float | None]:
    """Creep, its time constant [s] and the deviation of the creep; 0, 0.1 and None where no lag is found."""
    from scipy.optimize import least_squares

    known = samples.measured_normal if np.isfinite(samples.measured_normal).all() else samples.measured_shear
    estimated = samples.normal if known is samples.measured_normal else samples.shear
    none = 0.0, 0.1, None
    contacts = [part for part in _contacts(samples) if samples.started[part.start]]
    images = sum(part.stop - part.start for part in contacts)
    if not samples.in_time or images < _LAG_IMAGES or not np.isfinite(known).all() or not known.any():
        return none

    def residuals(unknown: Array) -> Array:
        """Relative to the largest force, with a factor of its own for each contact."""
        creep, log_time = unknown
        parts = []
        for part in contacts:
            expected = _after_rest(known[part], samples.stamp[part], creep, math.exp(log_time))
            factor = expected @ estimated[part] / max(float(estimated[part] @ estimated[part]), 1e-30)
            parts.append(factor * estimated[part] - expected)
        return np.asarray(np.concatenate(parts) / known.max())

    bounds = ([0, math.log(0.005)], [0.9, math.log(10.0)])
    fits = [least_squares(residuals, [0.1, math.log(time)], bounds=bounds) for time in (0.03, 0.1, 0.5)]
    best = min(fits, key=lambda fit: float(fit.cost))
    # Neighbouring images share their error: one in ten counts.
    count = images / 10
    left, plain = 2 * float(best.cost) + 1e-12, float((residuals(np.zeros(2)) ** 2).sum()) + 1e-12
    covariance = left / count * np.linalg.pinv(best.jac.T @ best.jac)
    creep, deviation = float(best.x[0]), float(np.sqrt(covariance[0, 0]))
    if count * math.log(plain / left) - 2 * math.log(images) < _LAG_EVIDENCE or creep < 2 * deviation:
        return none
    # During a shorter contact a lag looks like a factor, for example that of a wrong thickness.
    time = math.exp(best.x[1])
    longest = max(float(samples.stamp[part][-1] - samples.stamp[part][0]) for part in contacts)
    return (creep, time, deviation) if time < longest else none


def _contacts(samples: ForceSamples) -> list[slice]:
    starts = np.flatnonzero(np.diff(samples.contact, prepend=-1))
    return [slice(first, last) for first, last in zip(starts, [*starts[1:], len(samples.stamp)], strict=True)]


def _lagging(samples: ForceSamples, force: Array, creep: float, time: float) -> Array:
    """Measured forces [N] as the deformation follows them, from equilibrium where the start was not seen."""
    if not creep:
        return force
    parts = []
    for part in _contacts(samples):
        follow = _after_rest if samples.started[part.start] else deformation
        parts.append(follow(force[part], samples.stamp[part], creep, time))
    return np.concatenate(parts)


def _after_rest(force: Array, stamps: Array, creep: float, time: float) -> Array:
    """The deformation of one contact; the gel was free one image before."""
    interval = float(np.median(np.diff(stamps))) if len(stamps) > 1 else time
    return deformation(np.append(0.0, force), np.append(stamps[0] - interval, stamps), creep, time)[1:]


def _measurements(table: list[dict[str, str]], name: str, path: Path, *, in_time: bool) -> "_Measurements":
    rows = [row for row in table if row.get(name)]
    values = np.array([_number(row, name, path) for row in rows])
    if in_time:
        stamps = np.array([_number(row, "stamp", path) for row in rows])
        if (np.diff(stamps) <= 0).any():
            raise UsageError(f"{path}: stamps must increase")
        return _Measurements(stamps, values, {})
    for number, row in enumerate(table, start=1):
        if row.get(name) and not row["image"]:
            raise UsageError(f"{path}: row {number} has no image; name the image of its {name}")
    names = [row["image"] for row in rows]
    if twice := {image for image in names if names.count(image) > 1}:
        raise UsageError(f"{path}: {name} of {min(twice)} is there twice; keep one of them")
    return _Measurements(None, values, dict(zip(names, values.tolist(), strict=True)))


@dataclass(frozen=True)
class _Measurements:
    stamps: Array | None
    values: Array
    by_image: dict[str, float]

    def __call__(self, stamp: float, image: str) -> float:
        if self.stamps is None:
            return self.by_image.get(image, math.nan)
        return float(np.interp(stamp, self.stamps, self.values, math.nan, math.nan)) if len(self.values) else math.nan


def _read(path: Path, needed: tuple[str, ...]) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8-sig", newline="") as text:  # spreadsheets write a byte-order mark
            table = csv.DictReader(text)
            rows = list(table)
            names = list(table.fieldnames or ())
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"cannot read {path}: {error}") from None
    for number, row in enumerate(rows, start=1):
        if any(row.pop(None, ())):
            raise UsageError(f"{path}: row {number} has more cells than the header; a number has a decimal point")
    if twice := {name for name in names if name and names.count(name) > 1}:
        raise UsageError(f"{path} has the column {', '.join(sorted(twice))} twice; keep one of them")
    missing = [name for name in needed if rows and name not in rows[0]]
    if not rows or missing:
        raise UsageError(f"{path} is not a table of forces: {'it has no rows' if not rows else f'no {missing[0]}'}")
    return rows


def _number(row: dict[str, str], name: str, path: Path) -> float:
    try:
        value = float(row[name])
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{path}: {name} must be a number, got {row[name]!r}")
    return value
