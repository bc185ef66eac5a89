"""One case of a soak test: a mock robot with a random world and fault plan in one process, the runner in another."""

import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gelflow.errors import PeerError, PeerRefused
from gelflow.hardware_mocks.faults.plan import FaultPlan
from gelflow.hardware_mocks.faults.plan_file import plan_to_tables
from gelflow.hardware_mocks.faults.random_plan import random_plan
from gelflow.hardware_mocks.simulated_cell.random_world import changed_groups, random_world
from gelflow.hardware_mocks.simulated_cell.world import World, plain_world
from gelflow.mock_lab.robot_process import mock_robot, true_state
from gelflow.mock_lab.soak.rules import RunFacts, violations
from gelflow.mock_lab.soak.session_facts import longest_wait, read_session
from gelflow.real.runner.lab import Lab
from gelflow.real.runner.lab_file import load_lab
from gelflow.toml_tables import toml_text

REFUSED_WORLD = "no insertion: the mock robot refused the world"
_POLL = 0.25  # of the true state [s, wall]
_STILL = 1e-6  # change of a position that is no motion [m]
_WALL_LIMIT = 240.0  # of a run, in which robot time may have stopped [s, wall]
_OUTCOME_LENGTH = 60  # characters
_MESSAGE_LENGTH = 300  # characters
_END_LIMIT = 10.0  # from SIGTERM to the end of the runner [s, wall]


@dataclass(frozen=True)
class SoakCase:
    """A seed with its plan and world."""

    seed: int
    factor: float
    jitter: float  # added to the time limits of the lab file [s, wall]
    plan: FaultPlan
    world: World
    preset: str | None = None

    @classmethod
    def of(cls, seed: int, *, factor: float, jitter: float, preset: str | None) -> "SoakCase":
        """The case of a seed."""
        return cls(seed, factor, jitter, random_plan(seed), random_world(seed), preset)

    def run(self, keep: Path | None = None) -> dict[str, Any]:
        """Run the case and check the rules; returns the row for the ledger. `keep` is the folder for its files.

        Raises PeerError when the mock robot does not start, PeerRefused when it refuses the world.
        """
        begun = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="gelflow-soak-") as name:
            folder = Path(name)
            (folder / "plan.toml").write_text(toml_text(plan_to_tables(self.plan)))
            (folder / "world.toml").write_text(toml_text(plain_world(self.world)))
            with mock_robot(
                factor=self.factor,
                seed=self.seed,
                preset=self.preset,
                jitter=self.jitter,
                world=folder / "world.toml",
                faults=folder / "plan.toml",
            ) as (lab_file, truth_url):
                shutil.copy(lab_file, folder / "lab.toml")
                lab = load_lab(lab_file)
                watch = _run_insertion(lab_file, folder, truth_url, longest_wait(lab) + 1.0)
            row = self._row(folder, lab, watch) | {"wall": round(time.monotonic() - begun, 2)}
            if keep is not None and row["violations"]:
                shutil.copytree(folder, keep, dirs_exist_ok=True)
        return row

    def _row(self, folder: Path, lab: Lab, watch: "_Watch") -> dict[str, Any]:
        errors = (folder / "stderr.txt").read_text(errors="replace")
        session = read_session(folder / "run" / "session.mcap", lab)
        part = (watch.truth.get("parts") or [{}])[0]
        run = RunFacts(
            outcome=_outcome((folder / "stdout.txt").read_text(errors="replace"), errors),
            exit_code=watch.exit_code,
            errors=errors,
            idle=watch.idle,
            allowed_idle=watch.allowed_idle,
            truth=part,
            session=session,
        )
        broken = violations(run)
        return {
            "plan": str(self.plan),
            "kinds": sorted({fault.kind for fault in self.plan.faults}),
            "world": plain_world(self.world),
            "changed": changed_groups(self.world),
            "outcome": run.outcome,
            "exit_code": run.exit_code,
            "message": (errors.strip().splitlines() or [""])[-1][:_MESSAGE_LENGTH],
            "truth": {key: value for key, value in part.items() if key != "misalignment"},
            "faults": watch.truth.get("faults", []),
            "idle": round(run.idle, 2),
            "session": session,
            "violations": broken,
        }


@dataclass
class _Watch:
    """A run as seen from outside."""

    allowed_idle: float  # [s]
    exit_code: int | None = None  # None: it was ended
    truth: dict[str, Any] = field(default_factory=dict)
    idle: float = 0.0  # longest time without motion [s]
    _moved_at: float | None = None  # None before the first motion [s]
    _position: tuple[float, ...] = ()  # of tool and fingers

    def see(self, truth: dict[str, Any]) -> None:
        """Note a true state; motion of arm or fingers ends an idle time."""
        self.truth = truth
        position = (*truth["tool"], truth["width"])
        if any(abs(a - b) > _STILL for a, b in zip(position, self._position, strict=False)):
            self._moved_at = truth["time"]
        self._position = position
        if self._moved_at is not None:
            self.idle = max(self.idle, truth["time"] - self._moved_at)


def _run_insertion(lab_file: Path, folder: Path, truth_url: str, allowed_idle: float) -> _Watch:
    """Run `gelflow run insertion` for one part until it ends or hangs."""
    watch = _Watch(allowed_idle)
    command = "import sys; from gelflow.cli.main import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["run", "insertion", "--lab", str(lab_file), "--out", str(folder / "run"), "--json"]
    with (folder / "stdout.txt").open("wb") as out, (folder / "stderr.txt").open("wb") as errors:
        runner = subprocess.Popen(
            [sys.executable, "-c", command, *arguments], stdin=subprocess.DEVNULL, stdout=out, stderr=errors
        )
        try:
            end = time.monotonic() + _WALL_LIMIT
            while watch.exit_code is None and watch.idle <= allowed_idle and time.monotonic() < end:
                try:
                    watch.exit_code = runner.wait(_POLL)
                except subprocess.TimeoutExpired:
                    watch.see(true_state(truth_url))
        finally:
            _end(runner)
    watch.see(true_state(truth_url))
    return watch


def _end(runner: "subprocess.Popen[bytes]") -> None:
    if runner.poll() is None:
        runner.terminate()
        try:
            runner.wait(_END_LIMIT)
        except subprocess.TimeoutExpired:
            runner.kill()
            runner.wait()


def _outcome(output: str, errors: str) -> str:
    """The outcome of the part in the result of `gelflow run --json`, without numbers; else that of the run."""
    try:
        text = str(json.loads(output)["insertions"][0]["outcome"])
        return re.sub(r"\d+(\.\d+)?", "N", text)[:_OUTCOME_LENGTH]
    except (ValueError, KeyError, IndexError, TypeError):
        return "refused at preflight" if "preflight failed" in errors else "stopped by an error"


def _refused_row(case: SoakCase, message: str) -> dict[str, Any]:
    return {
        "plan": str(case.plan),
        "kinds": [],  # no fault took place
        "world": plain_world(case.world),
        "changed": changed_groups(case.world),
        "outcome": REFUSED_WORLD,
        "message": message[:_MESSAGE_LENGTH],
        "truth": {},
        "violations": [],
        "wall": 0.0,
    }


def try_case(case: SoakCase, keep: Path | None) -> dict[str, Any] | str:
    """The row of a case, or the reason why its mock robot failed.

    A refused world has a row without an insertion: its calibration fails each time, for example with markers that are
    too uneven.
    """
    try:
        return case.run(keep)
    except PeerRefused as error:
        return _refused_row(case, str(error))
    except PeerError as error:
        return str(error)
