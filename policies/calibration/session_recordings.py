"""Recordings for a calibration, from the sessions of the insertion runner."""

import dataclasses
import filecmp
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid, resampling_weights
from gelflow.part import Part
from gelflow.policies.calibration.recordings import Recordings
from gelflow.session.reader import SessionReader
from gelflow.session.records import Decision
from gelflow.sim.tasks.parts import with_shipped_mesh
from gelflow.task import InsertionTask

AT_REST = 0.05  # time that a simulated descent rests before the reading: a robot descends ten times more slowly [s]
_HEIGHT = 0.3e-3  # standard deviation of a part's height in the gripper, per attempt [m]
_ATTEMPT_KEYS = ("insertion", "attempt", "outcome", "planar_pose", "depth", "contact")  # that are read


def read_recordings(
    paths: Sequence[Path],
    *,
    part: Part | None = None,
    visible_markers: Callable[[Mapping[str, Any]], Sequence[NDArray[np.bool_]]] | None = None,
) -> Recordings:
    """Attempts with contact of one or several sessions of one task.

    Insertions are numbered over all sessions. `part` is the part of the sessions with the files of its meshes, which a
    session does not contain. `visible_markers` gives, from the description of a session, which printed markers of each
    pad its camera shows; the others, which the runner interpolates, are not compared. Raises UsageError when a session
    is given twice or is of another part or set-up (printed markers, cameras, grasp), a value is missing or not finite,
    its flow maps are not in millimetres, or there is no attempt with contact.
    """
    rows: list[dict[str, Any]] = []
    inserted: dict[int, np.ndarray[Any, Any]] = {}
    setup: _Setup | None = None
    planned: list[bool] = []  # only a session of planned motions names no policy
    visible: Sequence[NDArray[np.bool_]] = ()
    number = 0
    for k, path in enumerate(paths):
        with SessionReader(path) as session:
            for other in paths[:k]:
                if filecmp.cmp(path, other, shallow=False):  # a copy of a fitted insertion would be held out
                    raise UsageError(f"{path}: the same session as {other}; name it once")
            described = session.description()
            present = _Setup.of(path, described, part)
            if setup is None and visible_markers is not None:
                visible = visible_markers(described)
            setup = setup or present
            present.check(path, setup, paths[0])
            found, entered = _attempts(path, session, number, f"{path.stem}, " * (len(paths) > 1), present.task)
        planned += [described.get("checkpoint") is None] * len(found)
        rows += found
        inserted |= entered
        number = max([number, *(row["insertion"] + 1 for row in found), *(i + 1 for i in entered)])
    if setup is None or not rows:
        raise UsageError(
            f"{', '.join(map(str, paths))}: no attempt with contact is recorded, so nothing can be fitted; record "
            "insertions in which the part touches the rim"
        )
    keep = sorted({row["insertion"] for row in rows})
    new = {old: k for k, old in enumerate(keep)}
    return Recordings(
        setup.task,
        np.array([new[row["insertion"]] for row in rows], dtype=np.int64),
        np.array([row["planar_pose"] for row in rows], dtype=float),
        np.array([row["depth"] for row in rows], dtype=float),
        np.stack([row["flow"] for row in rows]),
        "mm",
        tuple(row["name"] for row in rows),
        {new[i]: pose for i, pose in inserted.items() if i in new},
        settle=AT_REST,
        printed=setup.printed,
        grasp_force=setup.grasp_force,
        grasp_height=setup.grasp_height,
        planned=np.array(planned),
        height_spread=_HEIGHT,
        measured=_measured(setup.task, setup.printed, visible),
    )


def _measured(task: InsertionTask, printed: Grid | None, visible: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Markers of the flow maps whose values come from visible printed markers only, (pads * rows * cols,)."""
    grid = task.grid
    if not visible:
        return np.ones(task.sensors * grid.rows * grid.cols, dtype=bool)
    weights = resampling_weights((printed or grid).positions(), grid)
    return np.concatenate([~(np.abs(weights[:, ~shown]) > 1e-9).any(1) for shown in visible])


def nothing_recorded(
    task: InsertionTask,
    *,
    grasp_force: float | None,
    grasp_height: float | None,
    printed: Grid | None = None,
    visible: Sequence[NDArray[np.bool_]] = (),
) -> Recordings:
    """Recordings of a lab without an attempt, for a plan.

    Parameters
    ----------
    grasp_force: commanded [N]; None: any of the randomization
    grasp_height: of the pad centres above the part's centre [m]; None: any of the randomization
    printed: the markers on each gel; None: those of the task
    visible: which printed markers of each pad its camera shows, (markers,) each; empty: all
    """
    flow = np.zeros((0, task.sensors, task.grid.rows, task.grid.cols, 2))
    return Recordings(
        task, np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0), flow, "mm", (),
        settle=AT_REST, printed=printed, grasp_force=grasp_force, grasp_height=grasp_height, height_spread=_HEIGHT,
        measured=_measured(task, printed, visible),
    )  # fmt: skip


@dataclass(frozen=True)
class _Setup:
    """The set-up of a session, which all sessions of a calibration share."""

    task: InsertionTask
    printed: Grid | None  # the markers on each gel; None in a session that does not name them
    mounts: Any  # of the cameras, as recorded
    grasp_force: float  # commanded [N]
    grasp_height: float  # of the pad centres above the part's centre [m]

    @classmethod
    def of(cls, path: Path, described: dict[str, Any], part: Part | None) -> "_Setup":
        """The set-up in the description of a session. Raises UsageError for another task, and without a grasp."""
        task = _task(path, described, part)
        try:
            mounts = described["mounts"]
            lab = described["lab"]
            force = float(lab["gripper"]["grasp_force"])
            height = float(lab["part"]["grasp_height"]) - task.part.size[2] / 2
            one = mounts[0]
            printed = Grid(one["rows"], one["cols"], one["pitch"], tuple(one["center"])) if "pitch" in one else None
        except (KeyError, IndexError, TypeError, ValueError):
            raise UsageError(
                f"{path}: the session has no camera mounts, or no lab file with grasp_force and grasp_height"
            ) from None
        return cls(task, printed, mounts, force, height)

    def check(self, path: Path, first: "_Setup", of_first: Path) -> None:
        """Raise UsageError when the set-up of the session `path` is not that of the first one."""
        for other, text in (
            (
                self.task.to_json() != first.task.to_json(),
                f"the session has another part or task than {of_first}",
            ),
            (self.printed != first.printed, f"the gels have other printed markers than in {of_first}"),
            (self.mounts != first.mounts, f"the cameras are mounted or calibrated differently than in {of_first}"),
            (
                self.grasp_force != first.grasp_force,
                f"the grasp force is {self.grasp_force:g} N, in {of_first} {first.grasp_force:g} N",
            ),
            (self.grasp_height != first.grasp_height, f"the part is grasped at another height than in {of_first}"),
        ):
            if other:
                raise UsageError(f"{path}: {text}; calibrate it alone")


def _task(path: Path, described: dict[str, Any], part: Part | None) -> InsertionTask:
    """The task of a session, with the files of the meshes of `part`, or of one that comes with gelflow."""
    data = described.get("task")
    if not isinstance(data, dict) or data.get("name") != "insertion":
        name = data.get("name") if isinstance(data, dict) else data
        raise UsageError(f"{path}: a calibration needs a session of the task insertion, got {name!r}")
    task = InsertionTask.from_json(dict(data))
    if part is None:
        part = with_shipped_mesh(task.part)
        for name, digest, file in (("part", part.mesh, part.mesh_file), ("hole", part.hole_mesh, part.hole_file)):
            if digest and not file:
                raise UsageError(
                    f"{path}: the {name} is a mesh, which a session does not contain; add --part PART.toml"
                )
    elif part != task.part:
        raise UsageError(f"{path}: the session has another part than --part; leave --part out, or give its part file")
    return dataclasses.replace(task, part=part)


def _attempts(
    path: Path, session: SessionReader, first: int, prefix: str, task: InsertionTask
) -> tuple[list[dict[str, Any]], dict[int, np.ndarray[Any, Any]]]:
    """Attempts with contact, and planar poses of inserted parts, by insertion counted from `first`.

    Names are those of the session itself, after `prefix`.
    """
    decisions: dict[tuple[int, int], Decision] = {}
    rows, inserted = [], {}
    for record in session.records(["/decision", "/attempt"]):
        value: Any = record.value
        if record.topic == "/decision":
            decisions[value.insertion, value.attempt] = value
            continue
        if missing := [key for key in _ATTEMPT_KEYS if key not in value]:
            raise UsageError(f"{path}: a record of /attempt has no {', '.join(missing)}; was it recorded by gelflow?")
        try:
            number, attempt = int(value["insertion"]), int(value["attempt"])
            planar, depth = np.array(value["planar_pose"], dtype=float), float(value["depth"])
        except (TypeError, ValueError, OverflowError):
            raise UsageError(f"{path}: a record of /attempt has a value of another kind: {dict(value)}") from None
        insertion, name = first + number, f"{prefix}insertion {number}, attempt {attempt}"
        if planar.shape != (3,) or not np.isfinite(planar).all():
            raise UsageError(f"{path}: {name}: planar_pose must be three finite numbers, got {value['planar_pose']}")
        if value["outcome"] == "inserted":
            inserted[insertion] = planar
        decision = decisions.get((number, attempt))
        if decision is None or not value["contact"] or value.get("slipped"):
            continue
        if decision.unit != "mm":
            raise UsageError(
                f"{path}: flow maps are in {decision.unit!r}, expected mm; give the cameras of the lab file a scale"
            )
        if decision.depths:
            depth = decision.depths[-1] - decision.depths[0]
        flow, shape = _vectors(decision), (task.sensors, task.grid.rows, task.grid.cols, 2)
        if flow.shape != shape:
            raise UsageError(f"{path}: {name} has a flow map of shape {flow.shape}, the task of the session {shape}")
        if not (np.isfinite(depth) and np.isfinite(flow).all()):
            raise UsageError(f"{path}: {name} contains values that are not finite")
        rows.append({"insertion": insertion, "name": name, "planar_pose": planar, "depth": depth, "flow": flow})
    return rows, inserted


def _vectors(decision: Decision) -> np.ndarray[Any, Any]:
    """Marker vectors (pads, rows, cols, 2) of the last frame."""
    channels, rows, cols = decision.flow.shape
    sensors = len(decision.tracked)
    frames = decision.flow.reshape(channels // (2 * sensors), sensors, 2, rows, cols)
    return np.asarray(frames[-1].transpose(0, 2, 3, 1) * decision.divisor, dtype=float)
