"""Mirror symmetry of the insertion task: inputs are mapped to one quarter of all misalignments.

A misalignment mirrored in x or y gives mirrored flow maps and requires the mirrored correction. The network receives
canonical inputs, mirrored to a fixed side, and its output is mirrored back. The policy is therefore exactly symmetric,
and training needs about a quarter of the attempts.
"""

import itertools
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.task import InsertionTask

Array = NDArray[np.float64]


def exponents(degree: int) -> list[tuple[int, int]]:
    """(power of row, power of column) of the polynomial terms up to `degree`, in the order of the features."""
    return [(i, total - i) for total in range(degree + 1) for i in range(total, -1, -1)]


@dataclass(frozen=True)
class Reflections:
    """The reflections of the features of a flow map and of corrections, by side = 2 (in x) + (in y).

    The pads are at ∓x of the gripper, so mirroring in x swaps them. Within a pad, mirroring in x or y reverses the
    columns and negates the y component of the shear, because the y axes of the pads are opposite.
    """

    order: NDArray[np.int64]  # of the features, shape (4, features)
    sign: Array  # of the features, shape (4, features)
    correction: Array  # signs of a correction, shape (4, 3)
    left: NDArray[np.int64]  # the features that are the mean shear (x, y) of the left pad in the last frame, shape (2,)
    right: NDArray[np.int64]  # of the right pad

    def side(self, features: Array, axes: Collection[str] = ("x", "y")) -> NDArray[np.int64]:
        """The side (n,) of features (n, …) on which reflections in `axes` make it canonical.

        The sign of the mean shear, left minus right, decides: its x component changes sign with x, its y with y.
        """
        x, y = (features[:, self.left] - features[:, self.right]).T
        return np.asarray(2 * ((x < 0) & ("x" in axes)) + ((y < 0) & ("y" in axes)))


def reflections(degree: int, task: InsertionTask) -> Reflections:
    """The reflections of the polynomial features up to `degree` of the task's flow maps."""
    terms = exponents(degree)
    frames, sensors = len(task.frame_depths), task.sensors
    shape = (frames, sensors, 2, len(terms))
    component, column = np.arange(2)[:, None], np.array([power for _, power in terms])
    flipped = np.broadcast_to((-1.0) ** (component + column), shape).reshape(-1)
    index = np.arange(flipped.size).reshape(shape)
    swapped = index[:, ::-1].reshape(-1)
    order, sign, correction = [], [], []
    for in_x, in_y in itertools.product((False, True), repeat=2):
        order.append(swapped if in_x else index.reshape(-1))
        sign.append(flipped if in_x != in_y else np.ones(flipped.size))
        correction.append([-1.0 if in_x else 1.0, -1.0 if in_y else 1.0, -1.0 if in_x != in_y else 1.0])
    last = index[-1]
    return Reflections(np.array(order), np.array(sign), np.array(correction), last[0, :, 0], last[1, :, 0])


class MirrorSymmetry:
    """Maps the inputs of a network with a history of attempts to the canonical side of the latest attempt."""

    def __init__(self, degree: int, history: int, task: InsertionTask) -> None:
        self._reflections = table = reflections(degree, task)
        self._axes = task.part.mirror
        self._order: list[NDArray[np.int64]] = []
        self._sign: list[Array] = []
        for features, permutation, correction in zip(table.sign, table.order, table.correction, strict=True):
            order = np.concatenate([i * permutation.size + permutation for i in range(history)])
            moves = np.tile(correction, history - 1)
            sign = np.concatenate([np.tile(features, history), moves, np.ones(history - 1), correction, [1.0]])
            self._order.append(np.concatenate([order, np.arange(order.size, sign.size)]))
            self._sign.append(sign)

    def canonical(self, inputs: Array) -> tuple[Array, Array]:
        """Inputs (n, inputs) mirrored to the canonical side, and the signs (n, 3) of the corrections."""
        side = self._reflections.side(inputs, self._axes)
        mirrored = np.take_along_axis(inputs, np.asarray(self._order)[side], axis=1) * np.asarray(self._sign)[side]
        return mirrored, self._reflections.correction[side]
