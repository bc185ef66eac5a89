"""Success of the included insertion policy when the cameras show only a part of the printed markers.

    python -m benchmarks.training.hidden_markers

The same markers are hidden on both pads. Their values are filled as in the runner (mean of six neighbours), from the
nearest visible marker, or with zeros. Writes a record.
"""

import sys
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from benchmarks import script
from numpy.typing import NDArray
from rich.table import Table

from gelflow.observation import Grid, TactileFrame, fill_invalid, resampling_weights
from gelflow.policies.checkpoint import default_checkpoint, load_network
from gelflow.policies.episodes import evaluate_task
from gelflow.policies.networks.base import Array, BatchPolicy
from gelflow.sim.tasks.gripper.flow_map_noise import FlowMapNoise
from gelflow.sim.tasks.registry import make_task
from gelflow.task import INSERTION

ENVS = 128
SENSORS = 2


class Part(NamedTuple):
    """The part of the flow map that is visible."""

    name: str
    rows: slice = slice(None)  # row 0 is at the base of the finger
    cols: slice = slice(None)

    def visible(self, grid: Grid) -> NDArray[np.bool_]:
        """Which markers are visible, shape (rows * cols,)."""
        result = np.zeros((grid.rows, grid.cols), dtype=bool)
        result[self.rows, self.cols] = True
        return result.reshape(-1)


PARTS = (
    Part("all"),
    Part("without 2 columns", cols=slice(1, -1)),
    Part("without 4 rows at the tip", rows=slice(0, -4)),
    Part("without 4 columns", cols=slice(2, -2)),
    Part("without 2 lines on every side", slice(2, -2), slice(2, -2)),
)

Fill = Callable[[NDArray[np.bool_], Grid], Array]  # (visible, grid) → weights (markers, markers) of the visible values


def mean_of_six(visible: NDArray[np.bool_], grid: Grid) -> Array:
    """As the runner fills them: its values of one marker at a time."""
    markers = len(visible)
    shear = np.repeat(np.eye(markers, dtype=np.float32)[:, :, None], 2, axis=2)
    valid = np.broadcast_to(visible, (markers, markers))
    frame = TactileFrame(shear, valid, grid.positions().astype(np.float32), 0.0, "N")
    return fill_invalid(frame)[:, :, 0].T * visible


def nearest(visible: NDArray[np.bool_], grid: Grid) -> Array:
    """The value of the nearest visible marker."""
    weights = np.zeros((len(visible), len(visible)))
    weights[:, visible] = resampling_weights(grid.positions()[visible], grid)
    return weights


def zero(visible: NDArray[np.bool_], grid: Grid) -> Array:
    """No motion."""
    return np.diag(visible.astype(float))


FILLS: Mapping[str, Fill] = {"mean of six neighbours": mean_of_six, "nearest marker": nearest, "zero": zero}


class Masked(BatchPolicy):
    """A policy that sees flow maps with hidden markers, filled by `weights` and normalized again."""

    def __init__(self, policy: BatchPolicy, weights: Array) -> None:
        self._policy, self._weights = policy, weights

    def reset(self, which: NDArray[np.bool_]) -> None:
        """Clears the memory of some environments."""
        self._policy.reset(which)

    def act(self, observations: NDArray[Any]) -> Array:
        """Actions (n, 3) of the policy."""
        vectors = observations.reshape(len(observations), SENSORS, 2, -1).astype(float)
        filled = np.einsum("gm,nscm->nscg", self._weights, vectors)
        scale = np.minimum(_longest(vectors), 1.0) / np.maximum(_longest(filled), 1e-9)
        return self._policy.act((filled * scale).reshape(observations.shape).astype(np.float32))


def _longest(vectors: Array) -> Array:
    """Length of the longest of the vectors (n, sensors, 2, markers) of each part, shape (n, 1, 1, 1)."""
    return np.asarray(np.linalg.norm(vectors, axis=2, keepdims=True).max(axis=(1, 3), keepdims=True))


def main() -> int:
    """Evaluate the policy with each visible part and each rule."""
    parser = script.parser(__doc__ or "", out="hidden_markers.json", quick="32 episodes of each", seed=4711)
    args = parser.parse_args()
    episodes = 32 if args.quick else 512
    network = load_network(default_checkpoint(), task=INSERTION)
    rows: list[dict[str, Any]] = []
    with script.progress("evaluations", len(PARTS) * len(FILLS)) as advance:
        for part in PARTS:
            visible = part.visible(INSERTION.grid)
            row: dict[str, Any] = {"visible": part.name, "share": float(visible.mean())}
            for name, fill in FILLS.items():
                task = make_task("insertion", min(ENVS, episodes), noise=FlowMapNoise())
                policy = Masked(network.batch_policy(task.num_envs), fill(visible, INSERTION.grid))
                row[name] = evaluate_task(name, policy, task, episodes=episodes, seed=args.seed).to_json()
                advance(1)
            rows.append(row)
    table = Table("visible markers", "share", *FILLS)
    for row in rows:
        cells = (f"{100 * row[name]['success']:.1f} % ({row[name]['corrections']:.2f})" for name in FILLS)
        table.add_row(row["visible"], f"{100 * row['share']:.0f} %", *cells)
    record = {"checkpoint": default_checkpoint().name, "episodes": episodes, "seed": args.seed, "results": rows}
    script.finish(args, script.header() | record, table)
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
