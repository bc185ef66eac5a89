"""The policy's network: a few numbers per flow map, the last attempts, a small perceptron. NumPy only.

A flat face in a grasp makes smooth flow maps, so each channel is first reduced to its least-squares fit by low
polynomials in row and column. That fixed linear layer averages the noise of the markers (130 values to 3 numbers) and
keeps what tells a misalignment: the mean force and its gradients over the pad.

One attempt cannot tell yaw from translation (either may load the same corner of the hole), so the network also sees
the attempts before and the corrections made between them. `History` builds that input in training and in use alike.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import FlowMap, Grid
from gelflow.policies.symmetry import MirrorSymmetry, exponents
from gelflow.task import InsertionTask

Array = NDArray[np.float64]
KIND = "polynomial-mlp"


@dataclass(frozen=True)
class Architecture:
    """What the tensors of a checkpoint mean."""

    kind: str = KIND
    degree: int = 1  # of the polynomials in row and column
    history: int = 5  # attempts that the network sees, the newest included
    hidden: tuple[int, ...] = (64, 64)  # units of each hidden layer (tanh)
    reach: tuple[float, float, float] = (8e-3, 8e-3, np.pi / 18)  # output ±1 means this correction [m, m, rad]

    def __post_init__(self) -> None:
        if self.kind != KIND:
            raise UsageError(f"network is of kind {self.kind!r}; this gelflow has {KIND!r}")
        if self.degree < 0 or self.history < 1 or not self.hidden or min(self.hidden) < 1:
            raise UsageError(f"a network needs degree ≥ 0, history ≥ 1 and hidden layers, got {self}")
        if len(self.reach) != 3 or min(self.reach) <= 0:
            raise UsageError(f"reach must be three positive numbers, got {self.reach}")

    def to_json(self) -> dict[str, Any]:
        """As plain data, for the checkpoint's header."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in vars(self).items()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Architecture":
        """The reverse of `to_json`. Raises UsageError on unknown keys."""
        known = {field.name for field in dataclasses.fields(cls)}
        if unknown := set(data) - known:
            raise UsageError(f"network has unknown keys {sorted(unknown)}; known are {sorted(known)}")
        values: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in data.items()
        }
        return cls(**values)

    def features(self, task: InsertionTask) -> int:
        """Numbers that one flow map is reduced to."""
        return task.observation_shape[0] * (self.degree + 1) * (self.degree + 2) // 2

    def inputs(self, task: InsertionTask) -> int:
        """Length of the perceptron's input: see `History.observe`."""
        return self.history * self.features(task) + (self.history - 1) * 4 + 4


def polynomial_basis(grid: Grid, degree: int) -> Array:
    """Orthogonal polynomials in row and column up to `degree`, sampled on `grid`; shape (rows * cols, terms).

    Scaled so that a feature `map @ basis` of a map equal to one polynomial of unit mean square is 1.
    """
    positions = grid.positions()
    half = np.maximum(np.abs(positions - positions.mean(0)).max(0), grid.pitch / 2)
    x, y = ((positions - positions.mean(0)) / half).T
    q, r = np.linalg.qr(np.stack([x**i * y**j for i, j in exponents(degree)], axis=1))
    return np.asarray(q * np.sign(np.diag(r)) / np.sqrt(len(positions)))


def reduce_maps(images: NDArray[Any], basis: Array) -> Array:
    """Features of flow maps: images (n, channels, rows, cols) → (n, channels * terms)."""
    n, channels = images.shape[:2]
    flat = images.reshape(n, channels, -1).astype(float)
    return np.asarray(np.einsum("ncp,pk->nck", flat, basis).reshape(n, -1))


class History:
    """The last attempts of `count` parts side by side, and the perceptron's input made of them."""

    def __init__(self, architecture: Architecture, task: InsertionTask, *, count: int = 1) -> None:
        self._attempts = task.attempts
        self._features: Array = np.zeros((count, architecture.history, architecture.features(task)))
        self._moves: Array = np.zeros((count, architecture.history - 1, 3))
        self._pose: Array = np.zeros((count, 3))
        self._seen: Array = np.zeros(count)
        self._reach: Array = np.asarray(architecture.reach)

    def reset(self, which: NDArray[np.bool_] | None = None) -> None:
        """Forget the parts marked in `which` (all where None): new ones are to be inserted."""
        mask = np.ones(len(self._seen), dtype=bool) if which is None else which
        for array in (self._features, self._moves, self._pose, self._seen):
            array[mask] = 0

    def observe(self, features: Array) -> Array:
        """Take in one attempt of every part; returns the perceptron's input, shape (count, inputs).

        Per part: features of the newest attempt and those before it (zero where there was none); corrections made
        between them, newest first; which of the earlier attempts exist; the way from the start as the gripper sees it
        now; the share of the attempts used up. Corrections and way are in units of the reach.
        """
        self._features = np.roll(self._features, 1, axis=1)
        self._features[:, 0] = features
        count, earlier = self._moves.shape[:2]
        existing = (self._seen[:, None] > np.arange(earlier)).astype(float)
        self._seen += 1
        cos, sin = np.cos(self._pose[:, 2]), np.sin(self._pose[:, 2])
        x, y, yaw = self._pose.T
        way = np.stack([cos * x + sin * y, cos * y - sin * x, yaw], axis=1) / self._reach
        used = self._seen[:, None] / self._attempts
        flat = [self._features.reshape(count, -1), self._moves.reshape(count, -1)]
        return np.concatenate([*flat, existing, way, used], axis=1)

    def record(self, corrections: Array) -> None:
        """Remember the corrections made after the newest attempt [m, m, rad in the gripper's frame], (count, 3)."""
        if self._moves.shape[1]:
            self._moves = np.roll(self._moves, 1, axis=1)
            self._moves[:, 0] = corrections / self._reach
        cos, sin = np.cos(self._pose[:, 2]), np.sin(self._pose[:, 2])
        dx, dy, dyaw = corrections.T
        self._pose += np.stack([cos * dx - sin * dy, sin * dx + cos * dy, dyaw], axis=1)


class Network:
    """Flow maps and history to corrections, from the tensors of a checkpoint.

    Sums run in NumPy's own loops rather than in a threaded matrix library: the same input gives the same bits
    whatever the number of threads, which replay relies on.
    """

    def __init__(self, architecture: Architecture, task: InsertionTask, tensors: Mapping[str, NDArray[Any]]) -> None:
        """Raises UsageError when a tensor is missing, of a wrong shape, or not finite."""
        self.architecture = architecture
        self.task = task
        expected = tensor_shapes(architecture, task)
        if set(tensors) != set(expected):
            raise UsageError(f"network has tensors {sorted(tensors)}; expected {sorted(expected)}")
        for name, shape in expected.items():
            if tensors[name].shape != shape:
                raise UsageError(f"tensor {name} has shape {tensors[name].shape}; expected {shape}")
            if not np.isfinite(tensors[name]).all():
                raise UsageError(f"tensor {name} has values that are not finite")
        self._mirrors = MirrorSymmetry(architecture.degree, architecture.history, task)
        self._basis: Array = tensors["basis"].astype(float)
        self._scale: Array = tensors["scale"].astype(float)
        depth = len(architecture.hidden) + 1
        self._layers = [
            (tensors[f"{i}.weight"].astype(float), tensors[f"{i}.bias"].astype(float)) for i in range(depth)
        ]

    def history(self, count: int = 1) -> History:
        """An empty history for `count` parts."""
        return History(self.architecture, self.task, count=count)

    def encode(self, images: NDArray[Any]) -> Array:
        """Features of flow maps (n, channels, rows, cols), each divided by its root mean square in training."""
        return reduce_maps(images, self._basis) / self._scale

    def canonical(self, inputs: Array) -> tuple[Array, Array]:
        """Perceptron inputs from `History.observe` inputs, and the signs of its outputs; see `MirrorSymmetry`."""
        return self._mirrors.canonical(inputs)

    def corrections(self, inputs: Array) -> Array:
        """Corrections (n, 3) [m, m, rad] for inputs that `History.observe` made."""
        values, signs = self.canonical(inputs)
        for weight, bias in self._layers[:-1]:
            values = np.tanh(np.einsum("ni,oi->no", values, weight) + bias)
        weight, bias = self._layers[-1]
        out = np.clip(np.einsum("ni,oi->no", values, weight) + bias, -1, 1)
        return np.asarray(out * signs * np.asarray(self.architecture.reach))


def tensor_shapes(architecture: Architecture, task: InsertionTask) -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor that a network has."""
    features = architecture.features(task)
    terms = features // task.observation_shape[0]
    sizes = [architecture.inputs(task), *architecture.hidden, 3]
    shapes: dict[str, tuple[int, ...]] = {"basis": (task.grid.rows * task.grid.cols, terms), "scale": (features,)}
    for i, (wide, narrow) in enumerate(itertools.pairwise(sizes)):
        shapes |= {f"{i}.weight": (narrow, wide), f"{i}.bias": (narrow,)}
    return shapes


class NetworkPolicy:
    """A network with the memory of one part: what the runner calls. Fits `gelflow.protocols.Policy`."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self._history = network.history()

    def reset(self) -> None:
        """Forget everything: a new part is to be inserted."""
        self._history.reset()

    def act(self, observation: FlowMap) -> Array:
        """One correction (dx [m], dy [m], dyaw [rad]) in the gripper's frame; deterministic.

        Raises UsageError when the map's shape is not the task's or it holds values that are not finite.
        """
        image, shape = observation.image, self.network.task.observation_shape
        if image.shape != shape:
            raise UsageError(f"flow map has shape {image.shape}; the policy takes {shape}")
        if not np.isfinite(image).all():
            raise UsageError("flow map has values that are not finite")
        inputs = self._history.observe(self.network.encode(image[None]))
        correction = self.network.corrections(inputs)
        self._history.record(correction)
        return np.asarray(correction[0])
