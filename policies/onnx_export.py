"""Export of a policy as an ONNX model, which other programs and languages run without gelflow.

Inputs are `observation` (n, …) float32 and, with a memory, `memory` (n, m), which is zero before a new episode. Outputs
are `action` (n, k) in ±1 of the task's environments and `next_memory`. The number n of environments is free.
"""

import json
import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import Checkpoint, load_checkpoint, replace_file
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.base import Architecture
from gelflow.policies.networks.mirror_symmetry import reflections
from gelflow.policies.networks.polynomial_gru import PolynomialGRU
from gelflow.policies.networks.polynomial_gru_torch import TorchPolynomialGRU
from gelflow.policies.networks.torch_actor import TorchActor
from gelflow.task import InsertionTask

_EXAMPLES = 2  # environments of the example from which the model is traced; any number but 1, which would stay fixed
_SUFFIX = ".onnx"
METADATA = "gelflow"  # key of the metadata: task, architecture, versions and digest of the checkpoint


class ActorStep(nn.Module):
    """One step of an actor."""

    def __init__(self, architecture: ActorArchitecture, checkpoint: Checkpoint) -> None:
        super().__init__()
        self.actor = TorchActor(architecture)
        self.actor.load_state_dict(_tensors(checkpoint))
        self.observation_shape, self.memory_size = architecture.observation_shape, architecture.recurrent

    def forward(self, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Action and next memory."""
        output, memory = self.actor(observation, memory)
        return output.clamp(-1, 1), memory


class PolynomialGRUStep(nn.Module):
    """One step of `PolynomialGRUPolicy`.

    The memory holds, in this order: the state of the GRU, the latest correction and the displacement from the start (x,
    y, yaw each; units of the reach), the side (0 to 3) and whether an attempt has been made.
    """

    def __init__(self, architecture: PolynomialGRU, checkpoint: Checkpoint) -> None:
        super().__init__()
        task = InsertionTask.from_json(dict(checkpoint.task))
        tensors = _tensors(checkpoint)
        self.basis, self.scale = nn.Buffer(tensors.pop("basis")), nn.Buffer(tensors.pop("scale"))
        self.layers = TorchPolynomialGRU(architecture, task)
        self.layers.load_state_dict(tensors)
        table = reflections(architecture.degree, task)
        self.order = nn.Buffer(torch.from_numpy(table.order))
        self.sign, self.correction_sign, self.axes, self.reach, self.reach_in_actions = (
            nn.Buffer(torch.as_tensor(np.asarray(values), dtype=torch.float32))
            for values in (
                table.sign,
                table.correction,
                task.corrected_axes,
                architecture.reach,
                np.asarray(architecture.reach) / np.asarray(task.action_scale),
            )
        )
        self.left, self.right = (nn.Buffer(torch.from_numpy(index)) for index in (table.left, table.right))
        self.mirror = nn.Buffer(
            torch.tensor([[2.0 * ("x" in architecture.mirror)], [1.0 * ("y" in architecture.mirror)]])
        )
        self._units = architecture.units
        self.observation_shape, self.memory_size = task.observation_shape, architecture.units + 8

    def forward(self, observation: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Action and next memory."""
        state, correction, displacement, side, started = memory.split([self._units, 3, 3, 1, 1], dim=1)
        features = (observation.flatten(2) @ self.basis).flatten(1) / self.scale
        shear = features.index_select(1, self.left) - features.index_select(1, self.right)
        seen = (shear < 0).to(shear.dtype) @ self.mirror
        side = torch.where(started > 0, side, seen)
        row = side[:, 0].long()
        signs = self.correction_sign[row]
        mirrored = features.gather(1, self.order[row]) * self.sign[row]
        inputs = torch.cat([mirrored, correction * signs, self._in_gripper_frame(displacement) * signs], dim=1)
        state = self.layers.gru(torch.tanh(self.layers.first(inputs)), state)
        output = self.layers.output(torch.tanh(self.layers.head(state))).clamp(-1, 1)
        correction = output * signs * self.axes
        displacement = displacement + self._from_gripper_frame(correction, displacement)
        memory = torch.cat([state, correction, displacement, side, torch.ones_like(side)], dim=1)
        return correction * self.reach_in_actions, memory

    def _in_gripper_frame(self, displacement: Tensor) -> Tensor:
        x, y, yaw = (displacement * self.reach).unbind(1)
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        return torch.stack([cos * x + sin * y, cos * y - sin * x, yaw], dim=1) / self.reach

    def _from_gripper_frame(self, correction: Tensor, displacement: Tensor) -> Tensor:
        x, y, turn = (correction * self.reach).unbind(1)
        yaw = displacement[:, 2] * self.reach[2]
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        return torch.stack([cos * x - sin * y, sin * x + cos * y, turn], dim=1) / self.reach


def export(checkpoint: Path, out: Path) -> None:
    """Writes the policy of a checkpoint as an ONNX model.

    Raises UsageError when the checkpoint cannot be read, its network has no export, the packages of the extra "onnx"
    are not installed, `out` has another suffix than .onnx or is the checkpoint, or the file cannot be written.
    """
    if out.suffix.lower() != _SUFFIX:
        raise UsageError(f"{out}: the suffix of the model must be {_SUFFIX}")
    if out.exists() and checkpoint.exists() and out.samefile(checkpoint):
        raise UsageError(f"{out} is the checkpoint; give the model another name")
    read = load_checkpoint(checkpoint)
    step = step_module(read.architecture, read)
    onnx = _onnx()
    inputs: dict[str, Tensor] = {"observation": torch.zeros(_EXAMPLES, *step.observation_shape)}
    outputs = ["action"]
    if step.memory_size:
        inputs["memory"] = torch.zeros(_EXAMPLES, step.memory_size)
        outputs.append("next_memory")
    else:
        step = _Memoryless(step)
    count = torch.export.Dim("n", min=1)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns of packages that no policy needs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, about its own parts
        program: Any = torch.onnx.export(
            step.eval(),
            tuple(inputs.values()),
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=tuple({0: count} for _ in inputs),
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    header = {"task": dict(read.task), "architecture": read.architecture.to_json(), "checkpoint": read.digest}
    onnx.helper.set_model_props(model, {METADATA: json.dumps({**header, "versions": dict(read.versions)})})
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        replace_file(out, model.SerializeToString())
    except OSError as error:
        raise UsageError(f"cannot write {out}: {error.strerror}") from error


class _Memoryless(nn.Module):
    """A step without the memory that its network does not have."""

    def __init__(self, step: nn.Module) -> None:
        super().__init__()
        self.step = step

    def forward(self, observation: Tensor) -> Tensor:
        """The action."""
        action: Tensor = self.step(observation, observation.new_zeros(0))[0]
        return action


_STEPS: tuple[tuple[type[Architecture], Callable[..., Any]], ...] = (
    (ActorArchitecture, ActorStep),
    (PolynomialGRU, PolynomialGRUStep),
)


def step_module(architecture: Architecture, checkpoint: Checkpoint) -> Any:
    """One step of the policy as a torch module. Raises UsageError for a network without export."""
    for kind, step in _STEPS:
        if isinstance(architecture, kind):
            return step(architecture, checkpoint)
    raise UsageError(f"network {architecture.kind} cannot be exported; train a policy of the present kind")


def _tensors(checkpoint: Checkpoint) -> dict[str, Tensor]:
    return {name: torch.from_numpy(np.array(values, dtype=np.float32)) for name, values in checkpoint.tensors.items()}


def _onnx() -> Any:
    """The module `onnx`."""
    try:
        import onnx
        import onnxscript  # noqa: F401  (the exporter of torch requires it)
    except ImportError as error:
        raise UsageError(f"the export requires {error.name}; install it with: pip install 'gelflow[onnx]'") from error
    return onnx
