"""The report of an evaluation: policy, oracle and random actions, films of episodes, and where failures lie."""

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import replace_file
from gelflow.policies.episodes import Episodes, Film, OraclePolicy, RandomPolicy, record_films, run_episodes
from gelflow.policies.evaluation import EvaluationResult
from gelflow.policies.networks.base import BatchPolicy, Network
from gelflow.policies.networks.flow_map_policy import FlowMapNetwork
from gelflow.policies.reports.failures import FailureRange, draw_failures, failure_ranges, worst_ranges
from gelflow.policies.training.folder import create_folder
from gelflow.session.records import to_plain
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.sim.tasks.task_batch import TaskBatch

RESULTS, EPISODES, FAILURES, FAILURE_PICTURE = "results.json", "episodes.csv", "failures.csv", "failures.png"
_FILMS = ("success.gif", "success.png", "failure.gif", "failure.png")
_OTHER_FILES = (EPISODES, FAILURES, FAILURE_PICTURE, *_FILMS)
FORMAT = 1  # of results.json
_MAX_FRAMES = 200  # of a film
_LAST_FRAME = 2000  # [ms]


@dataclass
class Report:
    """Results by actor, the policy's failures by randomized quantities, and the files that were written."""

    results: list[EvaluationResult] = field(default_factory=list)
    failures: list[FailureRange] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    error: Exception | None = None  # that ended the writing of the files

    def worst_ranges(self) -> list[str]:
        """A line for each of the quantities on which failures depend most."""
        return worst_ranges(self.failures)


class NoisyPolicy(BatchPolicy):
    """A policy of the insertion whose flow maps have the noise of cameras and gels."""

    def __init__(self, policy: BatchPolicy, noise: FlowMapNoise, count: int, sensors: int, seed: int) -> None:
        self._policy, self._noise, self._sensors = policy, noise, sensors
        self._rng = np.random.default_rng([seed, 3])
        self._of_part = np.zeros((count, 1 + 2 * sensors))

    def reset(self, which: NDArray[np.bool_]) -> None:
        """New pads in the environments `which`."""
        self._policy.reset(which)
        self._of_part[which] = self._noise.sample(int(which.sum()), self._sensors, self._rng)

    def act(self, observations: NDArray[Any]) -> NDArray[np.float64]:
        """Actions (n, k) for flow maps (n, …) with noise."""
        return self._policy.act(self._noise.apply(observations, self._of_part, self._rng))


def evaluate_all(
    network: Network,
    task: TaskBatch,
    *,
    episodes: int,
    seed: int,
    out: Path | None = None,
    started: Callable[[str], None] = lambda name: None,
) -> Report:
    """Evaluates the policy, the oracle (where the task has one) and random actions on episodes of the same seed.

    With `out`, writes results, episodes and failures as tables, a picture of the failures, and a film and the last
    picture of one success and one failure into this folder. `started` is called with the name of each evaluation.
    Raises UsageError when the folder cannot be written, or has files of these names that are not of an evaluation. An
    error of a later write is in the report, so that the results are not lost.
    """
    if out is not None:
        create_folder(out)
        _check_replaceable(out)
    report = Report()
    for name, actor in actors(network, task, seed=seed).items():
        started(name)
        found = run_episodes(actor, task, episodes=episodes, seed=seed)
        report.results.append(found.result(name))
        if name == "policy":
            own = found
    report.failures = failure_ranges(own)
    if out is None:
        return report
    try:
        _write_results(out, report)
        _remove_files(out)
        _write_tables(out, own, report)
        started("films of a success and a failure")
        report.files += _write_films(out, own, network, task, seed=seed)
    except (OSError, UsageError) as error:
        report.error = error
    return report


def actors(network: Network, task: TaskBatch, *, seed: int) -> dict[str, BatchPolicy]:
    """The policies of an evaluation by the name of their row.

    The names are "policy", "oracle" if the task has one, and "random". A network of flow maps adds the policy under
    noise and random corrections up to the largest of the network.
    """
    n = task.num_envs
    found: dict[str, BatchPolicy] = {"policy": network.batch_policy(n)}
    full = np.ones(task.action_space.shape)
    random: dict[str, BatchPolicy] = {"random": RandomPolicy(n, full, seed)}
    if isinstance(network, FlowMapNetwork):
        insertion = network.task
        noisy = NoisyPolicy(network.batch_policy(n), FlowMapNoise(), n, insertion.sensors, seed)
        found["policy, noisy flow maps"] = noisy
        reach = np.asarray(network.reach) / np.asarray(insertion.action_scale)
        random = {"random, up to the largest correction": RandomPolicy(n, reach, seed), **random}
    if has_oracle(task):
        found["oracle"] = OraclePolicy(task)
    return found | random


def has_oracle(task: TaskBatch) -> bool:
    """Whether the task has actions of an oracle."""
    try:
        task.oracle()
    except UsageError:
        return False
    return True


def _check_replaceable(out: Path) -> None:
    """Raises UsageError when the folder has a file of a report, but not the results of an evaluation."""
    present = [name for name in (RESULTS, *_OTHER_FILES) if (out / name).exists()]
    if not present:
        return
    try:
        is_evaluation = isinstance(json.loads((out / RESULTS).read_text("utf-8"))["results"], list)
    except (OSError, ValueError, KeyError, TypeError):
        is_evaluation = False
    if not is_evaluation:
        raise UsageError(f"{out / present[0]} would be replaced, and is not of an evaluation: choose another folder")


def _write_results(out: Path, report: Report) -> None:
    """Replaces the results as a whole, before all other files: on a full disk those of an earlier report remain."""
    rows = [entry.to_json() for entry in report.failures]
    values = {"format": FORMAT, "results": [result.to_json() for result in report.results], "failures": rows}
    replace_file(out / RESULTS, (json.dumps(to_plain(values), indent=2) + "\n").encode())
    report.files.append(out / RESULTS)


def _remove_files(out: Path) -> None:
    """Removes the other files of an earlier report; the new one need not have a failure, or a success."""
    for name in _OTHER_FILES:
        (out / name).unlink(missing_ok=True)


def _write_tables(out: Path, episodes: Episodes, report: Report) -> None:
    """Writes the episodes, and the failures, if there are any, as a table and as a picture."""
    with (out / EPISODES).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = [_with_unit(name, episodes.quantity_units[name]) for name in episodes.quantities]
        writer.writerow(["success", "failed", episodes.length_unit, "return", *episodes.metrics, *names])
        results = (episodes.success, episodes.failed, episodes.length, episodes.reward, *episodes.metrics.values())
        columns = (*results, *episodes.quantities.values())
        writer.writerows(zip(*(column.tolist() for column in columns), strict=True))
    report.files.append(out / EPISODES)
    rows = [entry.to_json() for entry in report.failures]
    if not rows:
        return
    with (out / FAILURES).open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    report.files.append(out / FAILURES)
    draw_failures(out / FAILURE_PICTURE, report.failures)
    report.files.append(out / FAILURE_PICTURE)


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _write_films(out: Path, episodes: Episodes, network: Network, task: TaskBatch, *, seed: int) -> list[Path]:
    """A film (GIF) and the last picture of the first success and of the first failure; none if there is none."""
    chosen: dict[str, Film] = {}
    for name, which in (("success", episodes.success), ("failure", ~episodes.success)):
        if which.any():
            chosen[name] = Film(int(np.flatnonzero(which)[0]))
    policy, count = network.batch_policy(task.num_envs), len(episodes.success)
    record_films(policy, task, list(chosen.values()), episodes=count, seed=seed, max_frames=_MAX_FRAMES)
    paths = []
    for name, film in chosen.items():
        paths += _write_film(out / name, film.frames, task.frames_per_second)
    return paths


def _write_film(path: Path, frames: Sequence[NDArray[np.uint8]], rate: float) -> list[Path]:
    from PIL import Image  # deferred: slow to import

    pictures = [Image.fromarray(frame) for frame in frames]
    duration = [1000 / min(rate, 25)] * (len(pictures) - 1) + [_LAST_FRAME]
    film, last = path.with_suffix(".gif"), path.with_suffix(".png")
    pictures[0].save(film, save_all=True, append_images=pictures[1:], duration=duration, loop=0)
    pictures[-1].save(last)
    return [film, last]
