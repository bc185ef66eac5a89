"""The recurrent policy of the insertion: polynomial features of the flow maps and a gated recurrent unit, in NumPy.

One attempt does not determine both yaw and translation, since both may load the same corner of the hole. The recurrent
unit combines all attempts of a part with the corrections between them. The first attempt of a part decides how the part
is mirrored (`Reflections`); all its attempts are mirrored alike, so the policy is exactly symmetric.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.policies.networks.base import Architecture, Array, Tensors, check_tensors
from gelflow.policies.networks.flow_map_policy import (
    CorrectionPolicy,
    FlowMapNetwork,
    in_frame_of_gripper,
    in_frame_of_start,
    insertion_task,
)
from gelflow.policies.networks.layers import gru_cell, linear
from gelflow.policies.networks.mirror_symmetry import reflections
from gelflow.policies.networks.polynomial_features import num_features, reduce_maps
from gelflow.policies.ranges import COUNT, COUNT_FROM_0, POSITIVE, check_settings
from gelflow.sim.arguments import check_mask
from gelflow.task import InsertionTask, TaskDescription

_MOTION = 6  # inputs beside the features: the latest correction, and the displacement from the start


@dataclass(frozen=True)
class PolynomialGRU(Architecture):
    """A linear layer (tanh), a gated recurrent unit (GRU), a linear layer (tanh) and a linear output."""

    kind: ClassVar[str] = "polynomial-gru"
    degree: int = 2  # of the polynomials in row and column
    units: int = 96  # of the first layer and of the GRU
    head: int = 64  # units between GRU and output
    reach: tuple[float, float, float] = (8e-3, 8e-3, np.pi / 18)  # correction for an output of ±1 [m, m, rad]
    mirror: tuple[str, ...] = ("x", "y")  # axes in which part and hole are symmetric: "x", "y", both or none

    def __post_init__(self) -> None:
        check_settings(self, degree=COUNT_FROM_0, units=COUNT, head=COUNT, reach=(POSITIVE, 3))
        if not set(self.mirror) <= {"x", "y"}:
            raise UsageError(f"mirror may contain 'x' and 'y', got {self.mirror}")

    def features(self, task: InsertionTask) -> int:
        """Number of features of one flow map."""
        return num_features(task.observation_shape[0], self.degree)

    def inputs(self, task: InsertionTask) -> int:
        """Number of inputs of the first layer."""
        return self.features(task) + _MOTION

    def layer_shapes(self, task: InsertionTask) -> dict[str, tuple[int, ...]]:
        """Name and shape of each trained tensor; names are those of the torch modules in `polynomial_gru_torch`."""
        units, head = self.units, self.head
        return {
            "first.weight": (units, self.inputs(task)),
            "first.bias": (units,),
            "gru.weight_ih": (3 * units, units),
            "gru.weight_hh": (3 * units, units),
            "gru.bias_ih": (3 * units,),
            "gru.bias_hh": (3 * units,),
            "head.weight": (head, units),
            "head.bias": (head,),
            "output.weight": (3, head),
            "output.bias": (3,),
        }

    def tensor_shapes(self, task: TaskDescription) -> dict[str, tuple[int, ...]]:
        """Name and shape of each tensor of a network for `task`."""
        task = insertion_task(task, self.kind)
        features = self.features(task)
        terms = features // task.observation_shape[0]
        fixed: dict[str, tuple[int, ...]] = {"basis": (task.grid.rows * task.grid.cols, terms), "scale": (features,)}
        return fixed | self.layer_shapes(task)

    def network(self, task: TaskDescription, tensors: Tensors) -> "PolynomialGRUNetwork":
        """The network with the given tensors. Raises UsageError when they do not fit."""
        return PolynomialGRUNetwork(self, insertion_task(task, self.kind), tensors)


class PolynomialGRUNetwork(FlowMapNetwork):
    """The network of a checkpoint, without memory.

    `einsum` uses NumPy's own loops instead of a threaded BLAS, so that results are bit-identical for any number of
    threads, as replay requires.
    """

    def __init__(self, architecture: PolynomialGRU, task: InsertionTask, tensors: Tensors) -> None:
        """Raises UsageError for missing tensors, wrong shapes and values that are not finite."""
        check_tensors(tensors, architecture.tensor_shapes(task))
        self.architecture: PolynomialGRU = architecture
        self.task = task
        self.reach = architecture.reach
        self.reflections = reflections(architecture.degree, task)
        self._tensors: dict[str, Array] = {name: values.astype(float) for name, values in tensors.items()}
        prefix = "gru."
        self._gru = {n.removeprefix(prefix): values for n, values in self._tensors.items() if n.startswith(prefix)}

    def batch_policy(self, count: int) -> "PolynomialGRUPolicy":
        """A policy for `count` parallel parts."""
        return PolynomialGRUPolicy(self, count)

    def encode(self, images: NDArray[Any]) -> Array:
        """Features of flow maps (n, channels, rows, cols), divided by their root mean square in training."""
        return reduce_maps(images, self._tensors["basis"]) / self._tensors["scale"]

    def step(self, inputs: Array, state: Array) -> tuple[Array, Array]:
        """Outputs (n, 3) and next states (n, units) for inputs (n, inputs); equations of the GRU as in torch."""
        state = gru_cell(np.tanh(self._linear("first", inputs)), state, self._gru)
        return self._linear("output", np.tanh(self._linear("head", state))), state

    def _linear(self, name: str, values: Array) -> Array:
        return linear(values, self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"])


class PolynomialGRUPolicy(CorrectionPolicy):
    """A network with the memory of `count` parts.

    `corrections` calls `observe`, the network, and `correct`; the training calls them itself, to record the inputs and
    to explore.
    """

    def __init__(self, network: PolynomialGRUNetwork, count: int) -> None:
        super().__init__(network.task, count)
        self.network = network
        self._reach = np.asarray(network.architecture.reach)
        self._state: Array = np.zeros((count, network.architecture.units))
        self._side: NDArray[np.int64] = np.zeros(count, dtype=np.int64)
        self._correction: Array = np.zeros((count, 3))  # the latest, in units of the reach
        self._displacement: Array = np.zeros((count, 3))  # from the start, in the frame of the start [m, m, rad]
        self.new: NDArray[np.bool_] = np.ones(count, dtype=bool)  # parts without an attempt in the memory

    @property
    def signs(self) -> Array:
        """Signs (count, 3) between a correction and the output of the network, which sees mirrored parts."""
        return self.network.reflections.correction[self._side]

    def reset(self, which: NDArray[np.bool_]) -> None:
        """Clears the memory of the parts marked in `which`."""
        check_mask(np.asarray(which), self._count)
        for array in (self._state, self._correction, self._displacement):
            array[which] = 0
        self.new[which] = True

    def observe(self, images: NDArray[Any]) -> Array:
        """Inputs (count, inputs) of the network for the latest flow maps, mirrored.

        They are the features, the latest correction, and the displacement from the start in the gripper frame, both in
        units of the reach.
        """
        table, features = self.network.reflections, self.network.encode(images)
        side = table.side(features, self.network.architecture.mirror)
        self._side = np.where(self.new, side, self._side)
        self.new[:] = False
        mirrored = np.take_along_axis(features, table.order[self._side], axis=1) * table.sign[self._side]
        displacement = in_frame_of_gripper(self._displacement) / self._reach
        return np.concatenate([mirrored, self._correction * self.signs, displacement * self.signs], axis=1)

    def output(self, inputs: Array) -> Array:
        """Output (count, 3) of the network for inputs from `observe`; updates the memory."""
        output, self._state = self.network.step(inputs, self._state)
        return output

    def correct(self, output: Array) -> Array:
        """The corrections (count, 3) [m, m, rad] of an output, which is limited to ±1; updates the memory."""
        self._correction = np.clip(output, -1, 1) * self.signs * self.network.task.corrected_axes
        corrections = np.asarray(self._correction * self._reach)
        self._displacement += in_frame_of_start(corrections, self._displacement)
        return corrections

    def corrections(self, images: NDArray[Any]) -> Array:
        """Corrections (count, 3) [m, m, rad] in the gripper frame for the latest flow maps; deterministic."""
        return self.correct(self.output(self.observe(images)))
