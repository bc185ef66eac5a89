"""A training run: one command, one seed and one folder, which the same command resumes after an interruption.

The folder holds `run.json` (configuration, command, versions), `progress.csv`, TensorBoard logs, `policy.safetensors`
(the best policy on the validation episodes), `state.safetensors` (the unfinished run) and `learning_curve.png`.
"""

import contextlib
import json
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from gelflow import __version__
from gelflow.errors import UsageError
from gelflow.policies.checkpoint import replace_file, save_checkpoint, task_differences
from gelflow.policies.episodes import evaluate_task
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.training import progress_curve
from gelflow.policies.training.folder import try_lock
from gelflow.policies.training.learner import Learner
from gelflow.policies.training.progress_log import ProgressLog
from gelflow.policies.training.state import load_state, save_state
from gelflow.session.records import readable_json
from gelflow.sim.tasks.task_batch import TaskBatch

FORMAT = 1
BEST_BY = ("success", "return")
_LARGEST_SEED = 2**64 - 1  # of the generators of torch
POLICY, STATE, CONFIGURATION = "policy.safetensors", "state.safetensors", "run.json"
PROGRESS, PICTURE, TENSORBOARD = "progress.csv", "learning_curve.png", "tensorboard"


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run that do not depend on the algorithm. Steps are environment steps, over all environments."""

    steps: int
    seed: int = 0
    minutes: float = float("inf")  # time limit; a run that reaches it is not reproducible
    evaluate_every: int = 10_000  # steps; the state is saved after each evaluation
    evaluate_episodes: int = 256
    best_by: str = "success"  # of the evaluations: "success", then return, or "return" alone

    def __post_init__(self) -> None:
        for name in ("steps", "minutes", "evaluate_every", "evaluate_episodes"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} of a training must be above 0, got {getattr(self, name)}")
        if not 0 <= self.seed <= _LARGEST_SEED:
            raise UsageError(f"the seed of a training must be 0 to 2^64 - 1, got {self.seed}")
        if self.best_by not in BEST_BY:
            raise UsageError(f"best_by must be one of {', '.join(BEST_BY)}, got {self.best_by!r}")


@dataclass(frozen=True)
class TrainingResult:
    """A finished run."""

    folder: Path
    best: EvaluationResult
    steps: int
    minutes: float
    seconds: dict[str, float]  # of the time: "simulation", "learning", "evaluation"
    checkpoint: Path  # the best policy on the validation episodes
    stored: bool = False  # of an earlier command, read from the folder

    @property
    def shares(self) -> dict[str, float]:
        """Shares of the time by name of `seconds`."""
        return {name: value / sum(self.seconds.values()) for name, value in self.seconds.items()}

    @property
    def picture(self) -> Path:
        """The learning curve."""
        return self.folder / PICTURE

    @property
    def curve(self) -> Path:
        """The numbers after each update, as a table."""
        return self.folder / PROGRESS


@dataclass(frozen=True)
class Progress:
    """The numbers after an update, and of an evaluation if there was one."""

    steps: int
    minutes: float
    numbers: Mapping[str, float]
    evaluation: EvaluationResult | None = None


@dataclass
class TrainingRun:
    """The run of a learner in `folder`.

    Parameters
    ----------
    validation: environments of the evaluations; its episodes are not those of the training
    configuration: all other values that determine the result, as JSON data: task options, algorithm
    command: command line that repeats the run, stored in the folder and in the checkpoint
    report: called after each update and each evaluation
    policy_name: of the checkpoint
    """

    learner: Learner
    validation: TaskBatch
    folder: Path
    settings: RunSettings
    configuration: Mapping[str, Any]
    command: Sequence[str] = ()
    report: Callable[[Progress], None] | None = None
    policy_name: str = POLICY
    _best: EvaluationResult | None = field(default=None, init=False)
    _seconds: float = field(default=0.0, init=False)  # of earlier processes

    @property
    def checkpoint(self) -> Path:
        """The best policy on the validation episodes, once there is one."""
        return self.folder / self.policy_name

    def is_finished(self) -> bool:
        """Whether the folder holds the result of this run. Raises UsageError when it holds another run."""
        if not (self.folder / CONFIGURATION).exists():
            return False
        stored = read_configuration(self.folder)
        self._check_same(stored)
        return bool(stored["finished"])

    def train(self) -> TrainingResult:
        """Trains until the steps or the minutes are used up, resuming an unfinished run of the same configuration.

        The result of a finished run of the same configuration is read from the folder: a command whose output was lost
        can be repeated. Raises UsageError when the folder cannot be written, is in use, or holds a run of another
        configuration, files of another origin, or no longer the best policy of this unfinished run.
        """
        torch.set_num_threads(1)  # small matrices; one thread makes a run repeatable
        with locked(self.folder):
            if self.is_finished() and (result := self._stored_result()) is not None:
                return result
            self._prepare()
            start = time.monotonic()
            log = ProgressLog(self.folder, (*self.learner.columns,), self.learner.steps)
            with contextlib.closing(log):
                self._train(log, start)
            return self._finish(start)

    def _train(self, log: ProgressLog, start: float) -> None:
        learner, s = self.learner, self.settings
        next_evaluation = (learner.steps // s.evaluate_every + 1) * s.evaluate_every
        while learner.steps < s.steps and (self._best is None or self._minutes(start) < s.minutes):
            numbers = learner.update()
            over = learner.steps >= s.steps or self._minutes(start) >= s.minutes
            evaluation = None
            if learner.steps >= next_evaluation or over:
                next_evaluation = (learner.steps // s.evaluate_every + 1) * s.evaluate_every
                evaluation = self._evaluate()
            progress = Progress(learner.steps, self._minutes(start), numbers, evaluation)
            log.add(progress.steps, progress.minutes, learner.clock.seconds, numbers, evaluation)
            if self.report:
                self.report(progress)
            if evaluation is not None and not over:
                self._save(start)
                learner.restart_episodes()

    def _minutes(self, start: float) -> float:
        return (self._seconds + time.monotonic() - start) / 60

    def _evaluate(self) -> EvaluationResult:
        """Evaluates the present policy; keeps it if it is the best."""
        learner, s = self.learner, self.settings
        tensors = learner.tensors()
        with learner.clock.timed("evaluation"):
            network = learner.architecture.network(self.validation.description, tensors)
            policy = network.batch_policy(self.validation.num_envs)
            seed = s.seed + 1_000_003  # differs from the seed of the training
            result = evaluate_task("validation", policy, self.validation, episodes=s.evaluate_episodes, seed=seed)
        if self._best is None or self._order(result) >= self._order(self._best):
            self._best = result
            save_checkpoint(
                self.checkpoint,
                task=self.validation.description,
                architecture=learner.architecture,
                tensors=tensors,
                training={**self._configuration(), "command": list(self.command), "steps": learner.steps}
                | {"validation": result.to_json()},
            )
        return result

    def _order(self, result: EvaluationResult) -> tuple[float, float]:
        """Sort key of an evaluation; larger is better."""
        return (result.success if self.settings.best_by == "success" else 0.0, result.reward)

    def _configuration(self) -> dict[str, Any]:
        """Everything that determines the result, as JSON data."""
        settings = {name: None if value == float("inf") else value for name, value in vars(self.settings).items()}
        return {
            "task": self.learner.task.description.to_json(),
            "environments": self.learner.task.num_envs,
            "architecture": self.learner.architecture.to_json(),
            "run": settings,
            **self.configuration,
        }

    def _prepare(self) -> None:
        """Checks the folder against the configuration, and restores the state of an unfinished run."""
        stored = read_configuration(self.folder) if (self.folder / CONFIGURATION).exists() else None
        if stored["finished"] if stored else self.checkpoint.exists():  # a policy of another origin is kept, too
            raise UsageError(f"{self.folder} already holds a trained policy; choose another folder or delete it")
        if stored:
            self._check_same(stored)
        else:
            for file in (self.folder / name for name in (PROGRESS, STATE, PICTURE, TENSORBOARD)):
                if file.exists():
                    raise UsageError(f"{file} is not of a run; choose another folder or delete it")
            self._write_configuration()
        if (self.folder / STATE).exists():
            self._check_checkpoint()  # an evaluation precedes each state
            state = load_state(self.folder / STATE)
            self.learner.load(state)
            self.learner.clock.seconds.update(state.values["run"]["shares"])
            self._seconds = state.values["run"]["seconds"]
            self._best = EvaluationResult(**state.values["run"]["best"])
            self.learner.restart_episodes()

    def _check_checkpoint(self) -> None:
        """Raises UsageError when the best policy of the evaluations so far is not in the folder."""
        if not self.checkpoint.exists():
            raise UsageError(
                f"{self.checkpoint}, the best policy of this unfinished run, is missing: put it back, or delete the "
                "folder"
            )

    def _check_same(self, stored: Mapping[str, Any]) -> None:
        configuration = json.loads(json.dumps(self._configuration()))
        if different := task_differences(_flat(stored["configuration"]), _flat(configuration)):
            kind = "a finished" if stored["finished"] else "an unfinished"
            advice = "delete it" if stored["finished"] else "repeat its command to resume it"
            raise UsageError(
                f"{self.folder} holds {kind} run with other settings: {different}; choose another folder, or {advice}"
            )

    def _save(self, start: float) -> None:
        state = self.learner.state()
        assert self._best is not None
        seconds = 60 * self._minutes(start)
        state.values["run"] = {
            "seconds": seconds,
            "shares": self.learner.clock.seconds,
            "best": {**vars(self._best)},
        }
        save_state(self.folder / STATE, state)

    def _write_configuration(self, *, result: Mapping[str, Any] | None = None) -> None:
        """Writes the configuration; with the result of the run, which is then finished."""
        versions = {"gelflow": __version__, "python": platform.python_version()}
        versions |= {"numpy": np.__version__, "torch": str(torch.__version__)}
        values = {"format": FORMAT, "finished": result is not None, "command": list(self.command), "versions": versions}
        if result is not None:
            values["result"] = result
        text = readable_json({**values, "configuration": self._configuration()})
        replace_file(self.folder / CONFIGURATION, text.encode())

    def _finish(self, start: float) -> TrainingResult:
        """Draws the learning curve and marks the run as finished."""
        assert self._best is not None
        self._check_checkpoint()
        progress_curve.draw(self.folder / PICTURE, self.folder / PROGRESS, title=self.learner.task.description.name)
        numbers: dict[str, Any] = {"steps": self.learner.steps, "minutes": self._minutes(start)}
        numbers["seconds"] = dict(self.learner.clock.seconds)
        self._write_configuration(result={"best": vars(self._best), **numbers})
        (self.folder / STATE).unlink(missing_ok=True)
        return TrainingResult(self.folder, self._best, checkpoint=self.checkpoint, **numbers)

    def _stored_result(self) -> TrainingResult | None:
        """The result in the folder of a finished run; None without its policy, or of an earlier version."""
        stored = read_configuration(self.folder).get("result")
        if stored is None or not self.checkpoint.exists():
            return None
        values = dict(stored)
        best = dict(values.pop("best"))
        best["metrics"] = {name: float(value) for name, value in best["metrics"].items()}  # not a number: text
        evaluation = EvaluationResult(**best | {name: float(best[name]) for name in ("length", "reward")})
        return TrainingResult(self.folder, evaluation, checkpoint=self.checkpoint, stored=True, **values)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Creates the folder and keeps other runs out of it. Raises UsageError when that is impossible."""
    file: IO[str]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / "lock").open("a")  # keeps the contents of a file that is not of a run
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror}") from error
    with file:
        if not try_lock(file):
            raise UsageError(f"{folder} is in use by another run; choose another folder")
        yield


def read_configuration(folder: Path) -> dict[str, Any]:
    """The contents of `run.json`. Raises UsageError when it is missing, damaged or newer."""
    path = folder / CONFIGURATION
    try:
        stored = json.loads(path.read_text("utf-8"))
        version = stored["format"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path} is not the configuration of a run ({type(error).__name__})") from error
    if version > FORMAT:
        raise UsageError(f"{path} has format {version}; this gelflow reads format {FORMAT}: update gelflow")
    return dict(stored)


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, with keys such as "ppo.batch"."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat
