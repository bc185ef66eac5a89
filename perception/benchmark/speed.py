"""What a tracker takes for an image that is decoded already, on one thread."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception.benchmark.baselines import Follower


@dataclass(frozen=True)
class Speed:
    """Processor time, the best of several runs: others on the machine only ever make a run slower."""

    start: float  # for the first image [ms]
    frame: float  # for each other image [ms]


def measure_speed(
    followers: Mapping[str, type[Follower]],
    images: Sequence[NDArray[np.uint8]],
    rest: NDArray[np.float64],
    seen: NDArray[np.bool_],
    rows: int,
    cols: int,
    *,
    repeats: int,
) -> dict[str, Speed]:
    """Times each of `followers` on `images`, in turn, `repeats` times; the others are as in `Follower.start`."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in followers}
    try:
        for _ in range(repeats):
            for name, kind in followers.items():
                follower = kind()
                begin = time.process_time()
                follower.start(images[0], rest, seen, rows, cols)
                started = time.process_time()
                for image in images[1:]:
                    follower.track(image)
                each = (time.process_time() - started) / (len(images) - 1)
                taken[name].append((1e3 * (started - begin), 1e3 * each))
    finally:
        cv2.setNumThreads(threads)
    return {name: Speed(*(min(times) for times in zip(*runs, strict=True))) for name, runs in taken.items()}
