"""Recorded attempts, as arrays: what a calibration reads of sessions."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import scipy.special
from numpy.typing import NDArray

from gelflow.observation import Grid, Unit, resampling_weights
from gelflow.task import InsertionTask

Array = NDArray[np.float64]

MODEL_ERROR = 0.02  # of a flow map that the model is not expected to reproduce, relative to its root mean square
_NOISY = 1.5  # median distance of a noisy marker from the range of its neighbours, relative to noise and model error


@dataclass(frozen=True)
class Recordings:
    """Attempts with contact of one or several insertions, n in all.

    `planar_pose` is that of the gripper in the taught frame of the hole. The misalignment of an insertion is the pose
    of this frame in the true frame of the hole; with it, the pose of the gripper in the hole frame is known.
    """

    task: InsertionTask
    insertion: NDArray[np.int64]  # (n,), counted from 0
    planar_pose: Array  # x [m], y [m], yaw [rad], shape (n, 3)
    depth: Array  # of the gripper at the reading, below the start of the attempt [m], shape (n,)
    flow: Array  # change of the marker vectors since the start, in `unit`, shape (n, pads, rows, cols, 2)
    unit: Unit
    names: tuple[str, ...]  # of the attempts, (n,)
    # Insertion → planar pose (3,) in which its part entered the hole.
    inserted: Mapping[int, Array] = field(default_factory=dict)
    settle: float = 0.0  # time between the end of the motion and the reading [s]
    printed: Grid | None = None  # the markers on each gel; None: those of the flow maps
    grasp_force: float | None = None  # commanded [N]; None: not recorded
    grasp_height: float | None = None  # of the pad centres above the part's centre, by the lab file [m]
    height_spread: float = 0.2e-3 / math.sqrt(3)  # standard deviation of the start height of an attempt [m]
    # Attempts that were motions of a plan, with a stop shear of their own, (n,); empty: none.
    planned: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    # Markers whose values are measured, not interpolated from others, (pads * rows * cols,); empty: all.
    measured: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    # Markers that are compared, (pads * rows * cols,); empty: the measured ones that are not noisy.
    used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    given_noise: float | None = None  # result of `noise`; None: it is estimated

    def __post_init__(self) -> None:
        if not len(self.planned):
            object.__setattr__(self, "planned", np.zeros(len(self.insertion), dtype=bool))
        if not len(self.measured):
            object.__setattr__(self, "measured", np.ones(math.prod(self.flow.shape[1:4]), dtype=bool))
        if not len(self.used):
            object.__setattr__(self, "used", self.measured & ~self._noisy_markers())

    def __len__(self) -> int:
        return len(self.insertion)

    def of(self, insertions: NDArray[np.int64]) -> "Recordings":
        """The attempts of some insertions, counted from 0 again, with the noise of all: few maps determine it badly."""
        rows = np.isin(self.insertion, insertions)
        number = {int(old): new for new, old in enumerate(np.unique(self.insertion[rows]))}
        return dataclasses.replace(
            self,
            insertion=np.array([number[int(i)] for i in self.insertion[rows]], dtype=np.int64),
            planar_pose=self.planar_pose[rows],
            depth=self.depth[rows],
            flow=self.flow[rows],
            planned=self.planned[rows],
            names=tuple(name for name, row in zip(self.names, rows, strict=True) if row),
            given_noise=self.noise(),
            inserted={number[i]: pose for i, pose in self.inserted.items() if i in number},
        )

    def noise(self) -> float:
        """Standard deviation of the difference of two readings of a marker, in `unit`: root mean square of both pads.

        From the second differences of the flow maps across rows and columns, in which smooth fields cancel. The lower
        quartile over the measured markers of a pad ignores the edges of contacts; the lower quartile over the attempts
        ignores the maps of firm contacts, which are not smooth.
        """
        if self.given_noise is not None:
            return self.given_noise
        differences = np.abs(_second_differences(self.flow))
        spread = self._second_difference_spread()
        of_pads = []
        for pad, where in enumerate(self._measured_neighbourhoods() & (spread > 1e-6)):
            sizes = np.quantile(differences[:, pad, where].reshape(len(self.flow), -1), 0.25, axis=1)
            of_pads.append(np.quantile(sizes, 0.25) / _lower_quartile(spread[where]))
        return float(np.sqrt(np.mean(np.square(of_pads))))

    def _measured_neighbourhoods(self) -> NDArray[np.bool_]:
        """Where a marker and its eight neighbours are measured, (pads, rows - 2, cols - 2); on a pad without: all."""
        _, pads, rows, cols, _ = self.flow.shape
        squares = np.lib.stride_tricks.sliding_window_view(self.measured.reshape(pads, rows, cols), (3, 3), (1, 2))
        whole = squares.all((3, 4))
        return np.asarray(np.where(np.any(whole, axis=(1, 2), keepdims=True), whole, True))

    def _second_difference_spread(self) -> Array:
        """Standard deviations (rows - 2, cols - 2) of the second differences, of noise with standard deviation 1.

        Markers that are interpolated between printed ones share part of their noise, so their second differences have
        different spreads: 0 where all neighbours are copies of one printed marker.
        """
        grid = self.task.grid
        if self.printed is None or self.printed == grid:
            return np.full((grid.rows - 2, grid.cols - 2), 6.0)
        weights = resampling_weights(self.printed.positions(), grid)
        fields = np.moveaxis(weights.reshape(grid.rows, grid.cols, -1), 2, 0)[:, None, :, :, None]
        spread = np.sqrt((_second_differences(fields) ** 2).sum(0))[0, ..., 0]
        return np.asarray(spread / np.sqrt((weights**2).sum(1).mean()))

    def stop_shear(self) -> tuple[float, float] | None:
        """Range of the shear along a finger at which descents stopped, in `unit`; None: all were motions of a plan.

        The shear of an attempt is the mean over the markers of the pad that has more of it. The range is from the lower
        quartile of the attempts to the largest: a descent that ends without a stop has less shear, one that stops late
        has more.
        """
        if self.planned.all():
            return None
        along = np.abs(self.flow[~self.planned][..., 0].mean((2, 3))).max(1)
        return float(np.quantile(along, 0.25)), float(along.max())

    def _noisy_markers(self) -> NDArray[np.bool_]:
        """Markers that are beyond the range of their neighbours in most attempts (pads * rows * cols,).

        Edges of contacts differ from the mean of their neighbours too, but they are within this range. As neighbours
        are compared with each other, at most a part of a pad can be noisy.
        """
        n, pads, rows, cols, _ = self.flow.shape
        if n == 0:
            return np.zeros(pads * rows * cols, dtype=bool)
        padded = np.pad(self.flow, ((0, 0), (0, 0), (1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        around = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
        near = np.stack([padded[:, :, i : i + rows, j : j + cols] for i, j in around])
        size = (np.nanmedian(near, axis=0) ** 2).mean((1, 2, 3, 4))  # without single defective markers
        expected = np.sqrt(self.noise() ** 2 + MODEL_ERROR**2 * size + 1e-30)
        beyond = np.maximum(self.flow - np.nanmax(near, axis=0), np.nanmin(near, axis=0) - self.flow)
        return np.asarray(np.median(beyond / expected[:, None, None, None, None], axis=(0, 4)) > _NOISY).reshape(-1)


def _lower_quartile(spread: Array) -> float:
    """Lower quartile of the magnitudes of values from normal distributions with standard deviations `spread` (n,)."""
    return float(np.quantile(spread[:, None] * np.abs(scipy.special.ndtri((np.arange(400) + 0.5) / 400)), 0.25))


def _second_differences(flow: Array) -> Array:
    """Second differences of fields (n, pads, rows, cols, k) across rows and columns: two rows and columns fewer."""
    corner = flow[:, :, 2:, 2:] + flow[:, :, 2:, :-2] + flow[:, :, :-2, 2:] + flow[:, :, :-2, :-2]
    edge = flow[:, :, 2:, 1:-1] + flow[:, :, :-2, 1:-1] + flow[:, :, 1:-1, 2:] + flow[:, :, 1:-1, :-2]
    return np.asarray(corner - 2 * edge + 4 * flow[:, :, 1:-1, 1:-1])
