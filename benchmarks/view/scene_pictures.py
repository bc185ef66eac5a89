"""Draws the five scenes of the paper, each with contact, into one picture: docs/pictures/scenes.png."""

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.sim.tasks.registry import make_task

# Task → action after n steps, number of steps.
_SCENES: dict[str, tuple[Callable[[int, int], NDArray[np.float64]], int]] = {
    "insertion": (lambda n, size: np.zeros(size), 0),
    "grasp": (lambda n, size: np.full(size, 0.2), 1),
    "pushing": (lambda n, size: np.array([1.0, 0.0, 0.0]), 12),
    "cap": (lambda n, size: np.resize([0.73, 0.96, 0.91], size), 10),
    "rolling": (lambda n, size: np.full(size, 0.3), 12),
}
_COLUMNS = 3
_ENVS = 32  # number of environments; the picture shows the one with the largest force


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/scenes.png"))
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    pictures = [draw(name, args.seed) for name in _SCENES]
    pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % _COLUMNS)
    rows = [np.hstack(pictures[i : i + _COLUMNS]) for i in range(0, len(pictures), _COLUMNS)]
    whole = cv2.resize(np.vstack(rows), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(args.out), whole[..., ::-1])
    print(f"wrote {args.out}")


def draw(name: str, seed: int) -> NDArray[np.uint8]:
    """The environment of a task that has the largest force on its pads after some steps."""
    act, steps = _SCENES[name]
    batch, rng = make_task(name, _ENVS, threads=1), np.random.default_rng(seed)
    batch.reset(batch.all, rng)
    size = batch.action_space.shape[0]
    for number in range(steps):
        batch.step(np.tile(act(number, size), (_ENVS, 1)), rng, active=~(batch.terminated | batch.truncated))
    if name in ("insertion", "grasp"):  # their simulators hold the end of an attempt
        return batch.render()
    force = batch.sim.tactile()[:_ENVS, :, 2].sum(axis=1)
    return batch.render(int(np.where(batch.terminated, 0.0, force).argmax()))


if __name__ == "__main__":
    main()
