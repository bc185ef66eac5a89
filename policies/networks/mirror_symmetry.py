"""Mirror symmetry of the insertion task: inputs are mapped to one quarter of all misalignments.

A misalignment mirrored in x or y gives mirrored flow maps and requires the mirrored correction. The network receives
canonical inputs, mirrored to a fixed side, and its output is mirrored back. The policy is therefore exactly symmetric,
and training needs about a quarter of the attempts.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from gelflow.task import InsertionTask

Array = NDArray[np.float64]


def exponents(degree: int) -> list[tuple[int, int]]:
    """(power of row, power of column) of the polynomial terms up to `degree`, in the order of the features."""
    return [(i, total - i) for total in range(degree + 1) for i in range(total, -1, -1)]


class MirrorSymmetry:
    """Maps network inputs to the canonical side. The pads are at ∓x of the gripper, so mirroring in x swaps them.

    Within a pad, mirroring in x or y reverses the columns and negates the y component of the shear, because the y axes
    of the pads are opposite.
    """

    def __init__(self, degree: int, history: int, task: InsertionTask) -> None:
        terms = exponents(degree)
        frames, sensors = len(task.frame_depths), task.sensors
        shape = (frames, sensors, 2, len(terms))
        component, column = np.arange(2)[:, None], np.array([power for _, power in terms])
        flipped = np.broadcast_to((-1.0) ** (component + column), shape).reshape(-1)
        index = np.arange(flipped.size).reshape(shape)
        swapped = index[:, ::-1].reshape(-1)
        self._order: list[NDArray[np.int64]] = []
        self._sign: list[Array] = []
        self._correction: list[Array] = []
        for in_x, in_y in itertools.product((False, True), repeat=2):
            reflected = in_x != in_y
            correction = np.array([-1.0 if in_x else 1.0, -1.0 if in_y else 1.0, -1.0 if reflected else 1.0])
            features = flipped if reflected else np.ones(flipped.size)
            permutation = swapped if in_x else index.reshape(-1)
            order = np.concatenate([i * permutation.size + permutation for i in range(history)])
            moves = np.tile(correction, history - 1)
            sign = np.concatenate([np.tile(features, history), moves, np.ones(history - 1), correction, [1.0]])
            self._order.append(np.concatenate([order, np.arange(order.size, sign.size)]))
            self._sign.append(sign)
            self._correction.append(correction)
        # Mean shear of the latest frame, left minus right: its x component changes sign with x, its y component with y.
        newest = index[-1]
        self._left, self._right = newest[0, :, 0], newest[1, :, 0]

    def canonical(self, inputs: Array) -> tuple[Array, Array]:
        """Inputs (n, inputs) mirrored to the canonical side, and the signs (n, 3) of the corrections."""
        x, y = (inputs[:, self._left] - inputs[:, self._right]).T
        which = 2 * (x < 0) + (y < 0)
        mirrored = np.take_along_axis(inputs, np.asarray(self._order)[which], axis=1) * np.asarray(self._sign)[which]
        return mirrored, np.asarray(self._correction)[which]
