"""A feedforward policy for the insertion: polynomial features, a history of attempts and a perceptron, in NumPy.

One attempt does not determine both yaw and translation, since both may load the same corner of the hole. The input
therefore contains the previous attempts and the corrections between them; `History` builds it in training and in use.
"""

import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks.base import Architecture, Tensors, check_tensors
from gelflow.policies.networks.flow_map_policy import (
    CorrectionPolicy,
    FlowMapNetwork,
    in_frame_of_gripper,
    in_frame_of_start,
    insertion_task,
)
from gelflow.policies.networks.layers import linear
from gelflow.policies.networks.mirror_symmetry import MirrorSymmetry
from gelflow.policies.networks.polynomial_features import num_features, reduce_maps
from gelflow.policies.ranges import COUNT, COUNT_FROM_0, POSITIVE, check_settings
from gelflow.sim.arguments import check_mask
from gelflow.task import InsertionTask, TaskDescription

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PolynomialMLP(Architecture):
    """Polynomial features of the last attempts and a perceptron; for the flow maps of the insertion."""

    kind: ClassVar[str] = "polynomial-mlp"
    degree: int = 1  # of the polynomials in row and column
    history: int = 5  # attempts in the input, including the latest
    hidden: tuple[int, ...] = (64, 64)  # units of each hidden layer (tanh)
    # Correction for an output of ±1 [m, m, rad]. The actions of the Gymnasium environments have their own scale,
    # `InsertionTask.action_scale`.
    reach: tuple[float, float, float] = (8e-3, 8e-3, np.pi / 18)

    def __post_init__(self) -> None:
        check_settings(self, degree=COUNT_FROM_0, history=COUNT, reach=(POSITIVE, 3))
        if not self.hidden or min(self.hidden) < 1:
            raise UsageError(f"a network requires hidden layers, got {self}")

    def features(self, task: InsertionTask) -> int:
        """Number of features of one flow map."""
        return num_features(task.observation_shape[0], self.degree)

    def inputs(self, task: InsertionTask) -> int:
        """Length of the perceptron input, see `History.observe`."""
        return self.history * self.features(task) + (self.history - 1) * 4 + 4

    def tensor_shapes(self, task: TaskDescription) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor of a network for `task`."""
        task = insertion_task(task, self.kind)
        features = self.features(task)
        terms = features // task.observation_shape[0]
        sizes = [self.inputs(task), *self.hidden, 3]
        shapes: dict[str, tuple[int, ...]] = {"basis": (task.grid.rows * task.grid.cols, terms), "scale": (features,)}
        for i, (wide, narrow) in enumerate(itertools.pairwise(sizes)):
            shapes |= {f"{i}.weight": (narrow, wide), f"{i}.bias": (narrow,)}
        return shapes

    def network(self, task: TaskDescription, tensors: Tensors) -> "PolynomialNetwork":
        """The network with the given tensors. Raises UsageError when they do not fit, or for another task."""
        return PolynomialNetwork(self, insertion_task(task, self.kind), tensors)


class History:
    """The last attempts of `count` parallel parts, and the perceptron input built from them."""

    def __init__(self, architecture: PolynomialMLP, task: InsertionTask, *, count: int = 1) -> None:
        self._max_attempts = task.attempts
        self._features: Array = np.zeros((count, architecture.history, architecture.features(task)))
        self._corrections: Array = np.zeros((count, architecture.history - 1, 3))
        self._pose: Array = np.zeros((count, 3))
        self._attempts_made: Array = np.zeros(count)
        self._reach: Array = np.asarray(architecture.reach)

    def reset(self, which: NDArray[np.bool_] | None = None) -> None:
        """Clears the history of the parts marked in `which`, or of all parts."""
        mask = np.ones(len(self._attempts_made), dtype=bool) if which is None else which
        for array in (self._features, self._corrections, self._pose, self._attempts_made):
            array[mask] = 0

    def observe(self, features: Array, which: NDArray[np.bool_] | None = None) -> Array:
        """Adds one attempt of each part, or of those marked in `which`; returns their perceptron inputs, (n, inputs).

        Per part: features of the latest and the previous attempts (zero if missing); corrections between them, latest
        first; flags of the existing previous attempts; displacement from the start in the current gripper frame;
        fraction of the attempts made. Corrections and displacement are in units of `PolynomialMLP.reach`.
        """
        rows = _rows(len(self._features), which)
        past = np.roll(self._features[rows], 1, axis=1)
        past[:, 0] = features
        self._features[rows] = past
        existing = (self._attempts_made[rows, None] > np.arange(self._corrections.shape[1])).astype(float)
        self._attempts_made[rows] += 1
        displacement = in_frame_of_gripper(self._pose[rows]) / self._reach
        progress = self._attempts_made[rows, None] / self._max_attempts
        flat = [values[rows].reshape(len(rows), -1) for values in (self._features, self._corrections)]
        return np.concatenate([*flat, existing, displacement, progress], axis=1)

    def record(self, corrections: Array, which: NDArray[np.bool_] | None = None) -> None:
        """Records the corrections (count, 3) after the latest attempt [m, m, rad], in the gripper frame.

        Those of parts that are not marked in `which` are ignored.
        """
        rows = _rows(len(self._features), which)
        if self._corrections.shape[1]:
            past = np.roll(self._corrections[rows], 1, axis=1)
            past[:, 0] = corrections[rows] / self._reach
            self._corrections[rows] = past
        self._pose[rows] += in_frame_of_start(corrections[rows], self._pose[rows])


def _rows(count: int, which: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    return np.arange(count) if which is None else np.flatnonzero(which)


class PolynomialNetwork(FlowMapNetwork):
    """The network of a checkpoint: corrections from flow maps and history.

    `einsum` uses NumPy's own loops instead of a threaded BLAS, so that results are bit-identical for any number of
    threads, as replay requires.
    """

    def __init__(self, architecture: PolynomialMLP, task: InsertionTask, tensors: Tensors) -> None:
        """Raises UsageError for missing tensors, wrong shapes and values that are not finite."""
        self.architecture: PolynomialMLP = architecture
        self.task: InsertionTask = task
        self.reach = architecture.reach
        check_tensors(tensors, architecture.tensor_shapes(task))
        self._symmetry = MirrorSymmetry(architecture.degree, architecture.history, task)
        self._basis: Array = tensors["basis"].astype(float)
        self._scale: Array = tensors["scale"].astype(float)
        depth = len(architecture.hidden) + 1
        self._layers = [
            (tensors[f"{i}.weight"].astype(float), tensors[f"{i}.bias"].astype(float)) for i in range(depth)
        ]

    def batch_policy(self, count: int) -> "PolynomialPolicy":
        """A policy for `count` parallel parts."""
        return PolynomialPolicy(self, count)

    def history(self, count: int = 1) -> History:
        """An empty history for `count` parts."""
        return History(self.architecture, self.task, count=count)

    def encode(self, images: NDArray[Any]) -> Array:
        """Features of flow maps (n, channels, rows, cols), divided by their root mean square in training."""
        return reduce_maps(images, self._basis) / self._scale

    def canonical(self, inputs: Array) -> tuple[Array, Array]:
        """Perceptron inputs from `History.observe` inputs, and the signs of its outputs; see `MirrorSymmetry`."""
        return self._symmetry.canonical(inputs)

    def corrections(self, inputs: Array) -> Array:
        """Corrections (n, 3) [m, m, rad] for inputs from `History.observe`."""
        values, signs = self.canonical(inputs)
        for weight, bias in self._layers[:-1]:
            values = np.tanh(linear(values, weight, bias))
        out = np.clip(linear(values, *self._layers[-1]), -1, 1)
        return np.asarray(out * signs * self.task.corrected_axes * np.asarray(self.architecture.reach))


class PolynomialPolicy(CorrectionPolicy):
    """A network with the history of `count` parts."""

    def __init__(self, network: PolynomialNetwork, count: int) -> None:
        super().__init__(network.task, count)
        self._network = network
        self._history = network.history(count)

    def reset(self, which: NDArray[np.bool_]) -> None:
        """Clears the history of the parts marked in `which`."""
        check_mask(np.asarray(which), self._count)
        self._history.reset(which)

    def corrections(self, images: NDArray[Any]) -> Array:
        """Corrections (count, 3) [m, m, rad] in the gripper frame for the latest flow maps; deterministic."""
        corrections = self._network.corrections(self._history.observe(self._network.encode(images)))
        self._history.record(corrections)
        return corrections
