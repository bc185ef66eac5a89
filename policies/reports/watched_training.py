"""A training that is watched while it runs: its curves, and episodes of its newest policy."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import UsageError
from gelflow.figures import rasterize
from gelflow.policies.checkpoint import Checkpoint, load_checkpoint, load_network
from gelflow.policies.episodes import Film, record_films, run_episodes
from gelflow.policies.recipes import DEFAULT, recipe_for
from gelflow.policies.reports.failures import failure_figure, failure_ranges, worst_ranges
from gelflow.policies.reports.shown_episodes import Image, ShownEpisodes
from gelflow.policies.training.progress_curve import figure_of
from gelflow.policies.training.run import CONFIGURATION, PROGRESS, STATE
from gelflow.sim.tasks.parts import load_part
from gelflow.sim.tasks.task_batch import TaskBatch

_PART = "--part"  # option of the command of a training
_ENVS = 32  # parallel environments
_MAX_FRAMES = 150  # of a film


def is_training(folder: Path) -> bool:
    """Whether the folder is that of `gelflow train`."""
    return (folder / CONFIGURATION).is_file()


class WatchedTraining:
    """The folder of a training run, which may still grow.

    Parameters
    ----------
    folder: of `gelflow train`
    episodes: number of episodes of an evaluation
    seed: of these episodes

    Raises UsageError when the folder is not that of a training.
    """

    def __init__(self, folder: Path, *, episodes: int = 128, seed: int = 1) -> None:
        if not is_training(folder):
            raise UsageError(
                f"{folder} is not the folder of a training: it has no {CONFIGURATION}; see gelflow train --out and "
                "gelflow eval --out"
            )
        self.folder, self._episodes, self._seed = folder, episodes, seed
        self._drawn = 0  # time of change of the curve that was drawn [ns]
        self._evaluated = ""  # digest of the policy

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    def curve(self) -> Image | None:
        """The learning curve; None before the first row, and if nothing has changed since the last call."""
        table = self.folder / PROGRESS
        changed = table.stat().st_mtime_ns if table.is_file() else 0
        if changed == self._drawn:
            return None
        try:
            picture = rasterize(figure_of(table, title=self.name))
        except (KeyError, ValueError, UsageError):  # no row yet, or the last one is being written
            return None
        self._drawn = changed
        return picture

    def evaluate(self, progress: Callable[[str], None] = lambda text: None) -> ShownEpisodes | None:
        """Episodes of the newest policy; None without a policy, and if it is that of the last call.

        Raises UsageError when the policy cannot act in the task, for example because its part file is missing.
        """
        path = self._policy()
        if path is None:
            return None
        checkpoint = load_checkpoint(path)
        if checkpoint.digest == self._evaluated:
            return None
        self._evaluated = checkpoint.digest
        progress("evaluating the newest policy")
        batch = self._batch(checkpoint)
        network = load_network(path, task=batch.description)
        count = batch.num_envs
        episodes = run_episodes(network.batch_policy(count), batch, episodes=self._episodes, seed=self._seed)
        ranges = failure_ranges(episodes)
        films = {
            name: Film(int(np.flatnonzero(which)[0]))
            for name, which in (("success", episodes.success), ("failure", ~episodes.success))
            if which.any()
        }
        result = episodes.result("policy")
        low, high = result.confidence_interval()
        lines = [
            f"newest policy: **{result.success:.1%}** of {result.episodes} episodes succeed "
            f"(95 %: {low:.1%} to {high:.1%}), return {result.reward:.1f}",
            *worst_ranges(ranges),
        ]
        progress("  \n".join([*lines, "drawing films of it"]))
        record_films(
            network.batch_policy(count), batch, list(films.values()),
            episodes=self._episodes, seed=self._seed, max_frames=_MAX_FRAMES,
        )  # fmt: skip
        picture = rasterize(failure_figure(ranges)) if ranges else None
        shown = {name: film.frames for name, film in films.items()}
        return ShownEpisodes("  \n".join(lines), picture, shown, batch.frames_per_second)

    def _policy(self) -> Path | None:
        found = [path for path in self.folder.glob("*.safetensors") if path.name != STATE]
        return max(found, key=lambda path: path.stat().st_mtime_ns, default=None)

    def _batch(self, checkpoint: Checkpoint) -> TaskBatch:
        """Environments of the task that the policy was trained for."""
        training = checkpoint.training
        recipe = recipe_for(str(checkpoint.task["name"]), training.get("recipe", DEFAULT))
        options = dict(training.get("options", {}))
        kind = type(recipe.make_task(1, **options).description)
        task = _with_meshes(kind.from_json(dict(checkpoint.task)), training.get("command", ()))
        return recipe.make_task(_ENVS, **{**options, "task": task})


def _with_meshes(task: Any, command: Sequence[str]) -> Any:
    """The task with the meshes of its part, which its description does not contain, from the part file of the command.

    Raises UsageError when the part file is missing, or describes another part.
    """
    if _PART not in command[:-1]:
        return task
    name = command[command.index(_PART) + 1]
    try:
        found = load_part(name)
    except UsageError as error:
        raise UsageError(f"{error}; start gelflow view in the folder where the training was started") from None
    if found.to_json()["part"] != task.to_json()["part"]:
        raise UsageError(f"part {name} has changed since the training was started, so no episodes are shown")
    return dataclasses.replace(task, part=found.part)
