"""Computing time and errors of a scene's reference motion for many settings.

A setting consists of overrides of `load_scene` and the interval between evaluations of marker forces. Errors are
relative to a reference with BDF2 and a very short step; the change by the last halving of its step is measured, too.
"""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import SimulationError
from gelflow.sim.benchmark.tradeoff.run import FRAME, Errors, MotionBenchmark, MotionResult, compare, randomized
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.scene.loader import scene_tables
from gelflow.sim.validation.reference_motions import reference_motion

STEPS = (1, 2, 4, 8, 16, 32)  # steps per frame of 10 ms: steps of 10 to 0.3125 ms
TOLERANCES = (1e-2, 1e-3, 1e-5, 1e-9)
LOOSE = 1e-3  # Newton's tolerance where settings are combined
EVERY = (2, 4, 8)  # frames between evaluations of marker forces
CONTACTS = (0.5, 1, 2)  # density of contact points along a length, relative to the scene
FINE, COARSE = (9, 6), (7, 4)  # halvings of a frame in the references: of the scene, and with dense contact points
DENSE = 4  # density of contact points in the reference of settings with other contact points
EXACT = {"integrator": "bdf2", "tolerance": 1e-10, "precision": "double"}
_CORNERS = 8  # the corners of a box are no samples of a surface, and are kept
# Groups with other arrays, outputs or physics, which do not dominate settings of other groups.
_SEPARATE = ("single", "markers", "contacts")
_EQUAL, _BETTER = 1.02, 0.9  # figures within 2 % count as equal, and 10 % lower as better

GROUPS = ("default", "step", "tolerance", "combined", "single", "reads", "markers", "contacts", "preset")

Overrides = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """Settings of a simulation."""

    name: str
    group: str  # varied quantity, one of GROUPS
    overrides: Mapping[str, Any]
    every: int = 1  # frames between evaluations of marker forces


@dataclass(frozen=True)
class Measurement:
    """Computing time and errors of one setting."""

    setting: Setting
    presets: tuple[str, ...]  # presets of the scene that equal this setting
    seconds: float  # median processor time per simulated second, one environment, one thread
    errors: Errors
    iterations: float  # Newton iterations per step
    dominated_by: str | None  # a setting that is not worse in any figure, and better in one

    @property
    def speed(self) -> float:
        """Simulated seconds per second."""
        return 1 / self.seconds


@dataclass(frozen=True)
class Tradeoff:
    """Measurements of all settings of a scene."""

    scene: str
    measurements: tuple[Measurement, ...]
    failed: Mapping[str, str]  # setting → reason of failure
    reference_step: float  # [s]
    changes: Mapping[str, Errors]  # reference → change by the last halving of its step
    repeats: int


def settings(scene: str | Path, *, quick: bool = False) -> list[Setting]:
    """Settings to measure: one factor at a time, and combinations of step, integrator, tolerance and precision."""
    own = load_scene(scene)
    cuts = STEPS[::2] if quick else STEPS
    timed = [_timed(integrator, cut, {}) for integrator in ("bdf1", "bdf2") for cut in cuts]
    scene_values = {"step": own.step, "integrator": own.integrator}
    found = [
        Setting(f"{_words(scene_values)} (default)", "default", {}),
        *(s for s in timed if s.overrides != scene_values),
    ]
    for tolerance in TOLERANCES:
        found.append(Setting(f"tolerance {_power(tolerance)}", "tolerance", {"tolerance": tolerance}))
    for precision in ("double", "single"):
        for integrator in ("bdf1", "bdf2"):
            for cut in cuts:
                found.append(_timed(integrator, cut, {"tolerance": LOOSE, "precision": precision}))
    found += [Setting(f"read at {1 / (every * FRAME):g} Hz", "reads", {}, every) for every in EVERY]
    found += [Setting(f"markers {name}", "markers", overrides) for name, overrides in _markers(own).items()]
    for density in CONTACTS:
        overrides = contact_density(own, density)
        if overrides:
            found.append(Setting(f"points ×{density:g}, per area", "contacts", overrides))
    return found


def _timed(integrator: str, cut: int, more: Overrides) -> Setting:
    values = {"step": FRAME / cut, "integrator": integrator, **more}
    group = "single" if more.get("precision") == "single" else "combined" if more else "step"
    return Setting(_words(values), group, values)


def _words(values: Overrides) -> str:
    words = [values["integrator"].upper(), f"{1e3 * values['step']:g} ms"]
    if "tolerance" in values:
        words.append(_power(values["tolerance"]))
    if values.get("precision") == "single":
        words.append("single")
    return " ".join(words)


def _power(number: float) -> str:
    return f"{number:.0e}".replace("e-0", "e-")


def _markers(scene: Scene) -> dict[str, Overrides]:
    """Overrides for coarser and finer marker grids of the same area, or with the same outermost markers."""
    grid = scene.pads[0].grid
    if grid is None or any(pad.grid is None for pad in scene.pads):
        return {}
    table = scene_tables(scene.path)["pads"][scene.pads[0].name]
    found: dict[str, Overrides] = {}
    if "size" in table:
        common = math.gcd(grid.rows, grid.cols)
        for part in (20, 4, 2):
            if common % part == 0:
                rows, cols = grid.rows // part, grid.cols // part
                found[f"{rows} × {cols}"] = {"pads.*.rows": rows, "pads.*.cols": cols}
        return found
    common = math.gcd(grid.rows - 1, grid.cols - 1)
    for part in sorted({1, common - 1, 2 * common} - {0, common}):
        rows, cols = 1 + (grid.rows - 1) * part // common, 1 + (grid.cols - 1) * part // common
        pitch = 1e-3 * grid.pitch * common / part
        overrides: Overrides = {"pads.*.rows": rows, "pads.*.cols": cols, "pads.*.pitch": pitch}
        found[f"{rows} × {cols}"] = overrides
    return found


def contact_density(scene: Scene, density: float) -> Overrides:
    """Overrides with `density` times the contact points along a length, and stiffness per area.

    Parameters per point are divided by the area of a point of the scene, so that the total stiffness is unchanged.
    """
    data = scene_tables(scene.path)
    found: Overrides = {}
    clouds = {p.name: p for p in scene.points if p.radius == 0 and len(p.points) > _CORNERS}
    for name in clouds:
        table, key = data["points"][name], f"points.{name}"
        if "resolution" in table:
            found[f"{key}.resolution"] = [max(2, round((n - 1) * density) + 1) for n in table["resolution"]]
        for word, least in (("angles", 3), ("radii", 1), ("heights", 2)):
            if word in table:
                found[f"{key}.{word}"] = max(least, round(table[word] * density))
        if "count" in table:
            found[f"{key}.count"] = max(1, round(table["count"] * density**2))
        found[f"{key}.stiffness"] = "per area"
    for name, table in data["contacts"].items():
        used = clouds.get(table["points"])
        if used is None or used.per_area:
            continue
        share = len(used.points) / float(used.areas.sum())
        for law in ("", "viscous.", "elastic."):
            numbers = table.get(law[:-1], {}) if law else table
            for number in ("kn", "kt", "kd", "ks"):
                if number in numbers:
                    found[f"contacts.{name}.{law}{number}"] = numbers[number] * share
    return found


def reference(
    scene: str | Path, halvings: int, more: Mapping[str, Any] | None = None, *, seed: int | None = None
) -> MotionResult:
    """Reference result: BDF2 with steps of 10 ms / 2^halvings; physics of the file, or sampled with `seed`."""
    return simulated(scene, {**(more or {}), **EXACT, "step": FRAME / 2**halvings}, seed=seed)


def simulated(scene: str | Path, overrides: Mapping[str, Any], *, seed: int | None = None) -> MotionResult:
    """Result with overrides; physics of the file, or sampled with `seed`."""
    loaded = load_scene(scene, overrides=overrides)
    return MotionBenchmark(loaded if seed is None else randomized(loaded, np.random.default_rng(seed))).run()


def measure(
    scene: str | Path, *, quick: bool = False, repeats: int = 9, done: Callable[[str, float], None] = lambda *_: None
) -> Tradeoff:
    """Measure all settings of a scene and its presets.

    Parameters
    ----------
    scene: name of an included scene
    quick: fewer settings, a coarser reference
    repeats: timed runs of each setting, interleaved; the median is reported
    done: called with the present task and the completed share

    Raises UsageError for a scene without a reference motion.
    """
    own = load_scene(scene)
    reference_motion(own)  # raises for a scene without one
    halvings = COARSE if quick else FINE
    references, changes = _references(own, scene, halvings, lambda share: done("reference", 0.3 * share))
    all_settings, presets = _with_presets(own, settings(scene, quick=quick))
    tasks: dict[str, MotionBenchmark] = {}
    errors: dict[str, Errors] = {}
    iterations, failed = {}, {}
    for at, setting in enumerate(all_settings):
        task = MotionBenchmark(load_scene(scene, overrides=setting.overrides), every=setting.every)
        try:
            run = task.run(onto=own)
        except SimulationError as error:
            failed[setting.name] = str(error)
        else:
            exact = references["points" if setting.group == "contacts" else "scene"]
            tasks[setting.name], errors[setting.name] = task, compare(run, exact)
            iterations[setting.name] = run.iterations / (task.steps * len(task.controls))
        done("errors", 0.3 + 0.3 * (at + 1) / len(all_settings))
    seconds = _seconds(tasks, repeats, lambda share: done("timing", 0.6 + 0.4 * share))
    groups = {s.name: s.group for s in all_settings}
    dominators = dominated({name: (seconds[name], *_figures(errors[name])) for name in tasks}, groups)
    measurements = tuple(
        Measurement(s, presets[s.name], seconds[s.name], errors[s.name], iterations[s.name], dominators[s.name])
        for s in all_settings
        if s.name in tasks
    )
    return Tradeoff(own.name, measurements, failed, FRAME / 2 ** halvings[0], changes, repeats)


def _references(
    own: Scene, scene: str | Path, halvings: tuple[int, int], done: Callable[[float], None]
) -> tuple[dict[str, MotionResult], dict[str, Errors]]:
    """References of the scene and of dense contact points, and their changes by the last halving of the step."""
    plain, dense = halvings
    kinds: dict[str, tuple[int, Overrides, Overrides]] = {"scene": (plain, {}, {})}
    if contact_density(own, 1):
        kinds["points"] = dense, contact_density(own, DENSE), contact_density(own, DENSE / 2)
    references, changes = {}, {}
    done(0.0)
    for at, (kind, (count, more, before)) in enumerate(kinds.items()):
        references[kind] = reference(scene, count, more)
        changes[kind] = compare(reference(scene, count - 1, before), references[kind])
        done((at + 1) / len(kinds))
    return references, changes


def _seconds(tasks: Mapping[str, MotionBenchmark], repeats: int, done: Callable[[float], None]) -> dict[str, float]:
    """Median processor time per simulated second; runs are interleaved, so that disturbances affect all settings."""
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for at in range(repeats):
        for name, task in tasks.items():
            times[name].append(task.seconds() / task.motion.duration)
        done((at + 1) / repeats)
    return {name: statistics.median(values) for name, values in times.items()}


def _figures(errors: Errors) -> tuple[float, ...]:
    return errors.position, errors.rotation, errors.markers, errors.flow, errors.gradient


def _with_presets(scene: Scene, all_settings: Sequence[Setting]) -> tuple[list[Setting], dict[str, tuple[str, ...]]]:
    """Settings extended by the remaining presets, and the presets that each setting equals."""
    own = {"step": scene.step, "integrator": scene.integrator, "tolerance": scene.tolerance}
    own |= {"precision": scene.precision}
    every = list(all_settings)
    presets: dict[str, tuple[str, ...]] = {s.name: () for s in every}
    for name, values in scene.presets.items():
        same = [s for s in every if {**own, **s.overrides} == {**own, **values} and s.every == 1]
        if not same:
            same = [Setting(f"preset {name}", "preset", dict(values))]
            every += same
        for setting in same:
            presets[setting.name] = (*presets.get(setting.name, ()), name)
    return every, presets


def dominated(figures: Mapping[str, Sequence[float]], groups: Mapping[str, str]) -> dict[str, str | None]:
    """For each setting, the fastest one that dominates it: not worse in any figure (by 2 %), better in one (by 10 %).

    Figures are minimized; the first one is the time. Settings of the groups `_SEPARATE` dominate only settings of
    their own group. None for settings that are not dominated.
    """
    found: dict[str, str | None] = {}
    for name, mine in figures.items():
        better = [
            (theirs[0], other)
            for other, theirs in figures.items()
            if (groups[other] not in _SEPARATE or groups[other] == groups[name])
            and all(t <= _EQUAL * m for t, m in zip(theirs, mine, strict=True))
            and any(t < _BETTER * m for t, m in zip(theirs, mine, strict=True))
        ]
        found[name] = min(better)[1] if better else None
    return found
