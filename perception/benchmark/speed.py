"""Processor time of trackers per decoded image, on one thread."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from gelflow.perception.benchmark.baselines import BenchmarkTracker


@dataclass(frozen=True)
class Speed:
    """Processor time, the minimum of several runs, since other processes only add to it."""

    start: float  # of the first image [ms]
    frame: float  # of each further image [ms]


def measure_speed(
    trackers: Mapping[str, type[BenchmarkTracker]],
    images: Sequence[NDArray[np.uint8]],
    rest: NDArray[np.float64],
    visible: NDArray[np.bool_],
    rows: int,
    cols: int,
    *,
    repeats: int,
) -> dict[str, Speed]:
    """Times each tracker on `images`, interleaved, `repeats` times; see `BenchmarkTracker.start` for the rest."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in trackers}
    try:
        with threadpool_limits(limits=1, user_api="blas"):  # idle threads of BLAS take processor time
            for _ in range(repeats):
                for name, kind in trackers.items():
                    tracker = kind()
                    begin = time.process_time()
                    tracker.start(images[0], rest, visible, rows, cols)
                    started = time.process_time()
                    for image in images[1:]:
                        tracker.track(image)
                    per_image = (time.process_time() - started) / (len(images) - 1)
                    times[name].append((1e3 * (started - begin), 1e3 * per_image))
    finally:
        cv2.setNumThreads(threads)
    return {name: Speed(*(min(values) for values in zip(*runs, strict=True))) for name, runs in times.items()}
