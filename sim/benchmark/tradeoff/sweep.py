"""What accuracy costs: a scene's motion under many settings, each with its time and its errors.

A setting is what `load_scene` takes as overrides, and how often markers are read. Errors are differences to a
reference, BDF2 with a step so short that one more halving changes next to nothing; by how much is measured and kept.
"""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import SimulationError
from gelflow.sim.benchmark.tradeoff.run import FRAME, Errors, Run, Task, compare, drawn
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.validation.reference_motions import reference_motion
from gelflow.toml_tables import read_toml

STEPS = (1, 2, 4, 8, 16, 32)  # that a frame of 10 ms is cut into: 10 to 0.3125 ms
TOLERANCES = (1e-2, 1e-3, 1e-5, 1e-9)
LOOSE = 1e-3  # Newton's tolerance where settings are combined
EVERY = (2, 4, 8)  # frames between readings
CONTACTS = (0.5, 1, 2)  # contact points along a length, against the scene's own
FINE, COARSE = (9, 6), (7, 4)  # halvings of a frame for the references: of the scene, and with dense points; quick ones
DENSE = 4  # contact points along a length in the reference of those settings
EXACT = {"integrator": "bdf2", "tolerance": 1e-10, "precision": "double"}
_CORNERS = 8  # points that are the corners of a box stay: they are no sample of a surface
_APART = ("single", "markers", "contacts")  # other arrays, readings or physics: they make no other setting needless
_EQUAL, _BETTER = 1.02, 0.9  # figures within 2 % are the same; one by 10 % lower is better

GROUPS = ("default", "step", "tolerance", "combined", "single", "reads", "markers", "contacts", "preset")

Overrides = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    """One way to simulate a scene."""

    name: str
    group: str  # what is varied, one of GROUPS
    overrides: Mapping[str, Any]
    every: int = 1  # frames of 10 ms between two readings


@dataclass(frozen=True)
class Measurement:
    """A setting, what it costs and how far it is off."""

    setting: Setting
    presets: tuple[str, ...]  # of the scene that are this setting
    seconds: float  # of the processor's time per simulated second, one environment and one thread; median
    errors: Errors
    iterations: float  # of Newton's method, per step
    dominated_by: str | None  # a setting that is no worse in anything, and better in something

    @property
    def speed(self) -> float:
        """Times faster than real time."""
        return 1 / self.seconds


@dataclass(frozen=True)
class Tradeoff:
    """All settings of a scene, in the order in which they were varied."""

    scene: str
    measurements: tuple[Measurement, ...]
    failed: Mapping[str, str]  # setting → why it could not be run
    reference_step: float  # [s]
    changes: Mapping[str, Errors]  # reference → what it changed by when its step was halved for the last time
    repeats: int


def settings(scene: str | Path, *, quick: bool = False) -> list[Setting]:
    """What is tried on a scene: one factor at a time, and step, integrator, tolerance and precision together."""
    own = load_scene(scene)
    cuts = STEPS[::2] if quick else STEPS
    timed = [_timed(integrator, cut, {}) for integrator in ("bdf1", "bdf2") for cut in cuts]
    mine = {"step": own.step, "integrator": own.integrator}
    found = [Setting(f"{_words(mine)} (default)", "default", {}), *(s for s in timed if s.overrides != mine)]
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
    """Coarser and finer grids on the same place: of the same area, or with the same outermost markers."""
    grid = scene.pads[0].grid
    if grid is None or any(pad.grid is None for pad in scene.pads):
        return {}
    table = read_toml(scene.path)["pads"][scene.pads[0].name]
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
    """Overrides that sample all contact points `density` times as densely along a length, their stiffness per area.

    Where it is per point, the contacts' numbers are divided by the area that one of the scene's own points stands for,
    so that all points together are as stiff as before.
    """
    data = read_toml(scene.path)
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
) -> Run:
    """The scene's motion by BDF2 with a frame of 10 ms halved so many times, the physics as in the file or drawn."""
    return simulated(scene, {**(more or {}), **EXACT, "step": FRAME / 2**halvings}, seed=seed)


def simulated(scene: str | Path, overrides: Mapping[str, Any], *, seed: int | None = None) -> Run:
    """The scene's motion under overrides, the physics as in the file or drawn with this seed."""
    loaded = load_scene(scene, overrides=overrides)
    return Task(loaded if seed is None else drawn(loaded, np.random.default_rng(seed))).run()


def measure(
    scene: str | Path, *, quick: bool = False, repeats: int = 9, done: Callable[[str, float], None] = lambda *_: None
) -> Tradeoff:
    """Try all settings of a scene and its presets.

    Parameters
    ----------
    scene: name of a scene that comes along
    quick: fewer settings, a coarser reference
    repeats: timed runs of each setting, all settings in turn, of which the median counts
    done: told what is being done, and which share of all

    Raises UsageError for a scene without a motion.
    """
    own = load_scene(scene)
    reference_motion(own)  # raises where there is none
    halvings = COARSE if quick else FINE
    truths, changes = _references(own, scene, halvings, lambda share: done("reference", 0.3 * share))
    tried, presets = _with_presets(own, settings(scene, quick=quick))
    tasks: dict[str, Task] = {}
    errors: dict[str, Errors] = {}
    iterations, failed = {}, {}
    for at, setting in enumerate(tried):
        task = Task(load_scene(scene, overrides=setting.overrides), every=setting.every)
        try:
            run = task.run(onto=own)
        except SimulationError as error:
            failed[setting.name] = str(error)
        else:
            truth = truths["points" if setting.group == "contacts" else "scene"]
            tasks[setting.name], errors[setting.name] = task, compare(run, truth)
            iterations[setting.name] = run.iterations / (task.steps * len(task.controls))
        done("errors", 0.3 + 0.3 * (at + 1) / len(tried))
    seconds = _seconds(tasks, repeats, lambda share: done("timing", 0.6 + 0.4 * share))
    groups = {s.name: s.group for s in tried}
    beaten = dominated({name: (seconds[name], *_figures(errors[name])) for name in tasks}, groups)
    measurements = tuple(
        Measurement(s, presets[s.name], seconds[s.name], errors[s.name], iterations[s.name], beaten[s.name])
        for s in tried
        if s.name in tasks
    )
    return Tradeoff(own.name, measurements, failed, FRAME / 2 ** halvings[0], changes, repeats)


def _references(
    own: Scene, scene: str | Path, halvings: tuple[int, int], done: Callable[[float], None]
) -> tuple[dict[str, Run], dict[str, Errors]]:
    """What settings are compared with, of the scene and with dense points, and what their last halving changed."""
    plain, dense = halvings
    families: dict[str, tuple[int, Overrides, Overrides]] = {"scene": (plain, {}, {})}
    if contact_density(own, 1):
        families["points"] = dense, contact_density(own, DENSE), contact_density(own, DENSE / 2)
    truths, changes = {}, {}
    done(0.0)
    for at, (family, (count, more, before)) in enumerate(families.items()):
        truths[family] = reference(scene, count, more)
        changes[family] = compare(reference(scene, count - 1, before), truths[family])
        done((at + 1) / len(families))
    return truths, changes


def _seconds(tasks: Mapping[str, Task], repeats: int, done: Callable[[float], None]) -> dict[str, float]:
    """Per simulated second; all in turn, so that a disturbance of the machine hits all alike."""
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for at in range(repeats):
        for name, task in tasks.items():
            times[name].append(task.seconds() / task.motion.duration)
        done((at + 1) / repeats)
    return {name: statistics.median(values) for name, values in times.items()}


def _figures(errors: Errors) -> tuple[float, ...]:
    return errors.position, errors.rotation, errors.markers, errors.flow, errors.gradient


def _with_presets(scene: Scene, tried: Sequence[Setting]) -> tuple[list[Setting], dict[str, tuple[str, ...]]]:
    """Settings with those presets that are none of them, and which presets each setting is."""
    own = {"step": scene.step, "integrator": scene.integrator, "tolerance": scene.tolerance}
    own |= {"precision": scene.precision}
    every = list(tried)
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
    """For each setting the one, if any, that is no worse in any figure (2 % apart) and better in some (10 %).

    Figures are such that less is better, time first; of several settings the one with the least time is named. Settings
    in single precision, with other markers or other points are better only than their like.
    """
    found: dict[str, str | None] = {}
    for name, mine in figures.items():
        better = [
            (theirs[0], other)
            for other, theirs in figures.items()
            if (groups[other] not in _APART or groups[other] == groups[name])
            and all(t <= _EQUAL * m for t, m in zip(theirs, mine, strict=True))
            and any(t < _BETTER * m for t, m in zip(theirs, mine, strict=True))
        ]
        found[name] = min(better)[1] if better else None
    return found
