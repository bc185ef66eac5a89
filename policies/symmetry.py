"""The symmetry of part, hole and gripper, used: each attempt is mirrored to one quarter of all misalignments.

A misalignment mirrored in x or y gives the mirrored flow maps and wants the mirrored correction. The network only ever
sees attempts mirrored to a fixed side, and its answer is mirrored back: it need not learn the same thing four times,
and it cannot treat left and right differently. In training this saves about three quarters of the attempts.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from gelflow.task import InsertionTask

Array = NDArray[np.float64]


def exponents(degree: int) -> list[tuple[int, int]]:
    """(power of row, power of column) of every polynomial term up to `degree`, in the order of the features."""
    return [(i, total - i) for total in range(degree + 1) for i in range(total, -1, -1)]


class MirrorSymmetry:
    """Mirrored inputs of the network. Pads sit at the gripper's ∓x, so mirroring x swaps them.

    On a pad, mirroring x or y runs the columns backwards and turns the shear's y over (the pads' y axes are opposite).
    """

    def __init__(self, degree: int, history: int, task: InsertionTask) -> None:
        terms = exponents(degree)
        frames, sensors = len(task.frame_depths), task.sensors
        shape = (frames, sensors, 2, len(terms))
        component, column = np.arange(2)[:, None], np.array([power for _, power in terms])
        backwards = np.broadcast_to((-1.0) ** (component + column), shape).reshape(-1)
        places = np.arange(backwards.size).reshape(shape)
        swapped = places[:, ::-1].reshape(-1)
        self._order: list[NDArray[np.int64]] = []
        self._sign: list[Array] = []
        self._correction: list[Array] = []
        for in_x, in_y in itertools.product((False, True), repeat=2):
            turned = in_x != in_y
            correction = np.array([-1.0 if in_x else 1.0, -1.0 if in_y else 1.0, -1.0 if turned else 1.0])
            features = backwards if turned else np.ones(backwards.size)
            one = swapped if in_x else places.reshape(-1)
            order = np.concatenate([i * one.size + one for i in range(history)])
            moves = np.tile(correction, history - 1)
            sign = np.concatenate([np.tile(features, history), moves, np.ones(history - 1), correction, [1.0]])
            self._order.append(np.concatenate([order, np.arange(order.size, sign.size)]))
            self._sign.append(sign)
            self._correction.append(correction)
        # The newest frame's mean shear, left minus right: its x turns over with x, its y with y.
        newest = places[-1]
        self._left, self._right = newest[0, :, 0], newest[1, :, 0]

    def canonical(self, inputs: Array) -> tuple[Array, Array]:
        """Inputs (n, inputs) mirrored to the fixed side, and what to multiply the network's corrections by (n, 3)."""
        x, y = (inputs[:, self._left] - inputs[:, self._right]).T
        which = 2 * (x < 0) + (y < 0)
        mirrored = np.take_along_axis(inputs, np.asarray(self._order)[which], axis=1) * np.asarray(self._sign)[which]
        return mirrored, np.asarray(self._correction)[which]
