"""ONNX models of policies: equal actions over whole episodes, with a memory and without, and clear errors."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.policies.toy_insertion import images

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.part import CUBOID
from gelflow.policies.checkpoint import default_checkpoint, load_checkpoint, load_network, save_checkpoint
from gelflow.policies.networks.actor import ActorArchitecture
from gelflow.policies.networks.cnn import CNN
from gelflow.policies.networks.mlp import MLP
from gelflow.policies.networks.polynomial_features import polynomial_basis
from gelflow.policies.networks.polynomial_gru import PolynomialGRU
from gelflow.policies.networks.torch_actor import TorchActor
from gelflow.policies.onnx_export import METADATA, export
from gelflow.task import INSERTION, InsertionTask, TaskDescription, insertion_task

ACTORS: list[ActorArchitecture] = [
    MLP((7,), 3, hidden=(16, 16)),
    MLP((7,), 3, hidden=(16,), recurrent=5),
    CNN((4, 13, 10), 2),
    CNN((4, 13, 10), 2, recurrent=6),
]


def session(path: Path) -> Any:
    runtime = pytest.importorskip("onnxruntime")
    return runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def check_equal_actions(checkpoint: Path, task: TaskDescription, observations: list[Any], memory_size: int) -> None:
    """Compares the model with the NumPy policy; environment 1 starts a new episode after two steps."""
    pytest.importorskip("onnx"), pytest.importorskip("onnxscript")
    model = checkpoint.with_suffix(".onnx")
    export(checkpoint, model)
    run, count = session(model), len(observations[0])
    policy = load_network(checkpoint, task=task).batch_policy(count)
    memory = np.zeros((count, memory_size), np.float32)
    for i, observation in enumerate(observations):
        if i == 2:
            policy.reset(np.arange(count) == 1)
            memory[1] = 0
        inputs = {"observation": observation, "memory": memory} if memory_size else {"observation": observation}
        action, *rest = run.run(None, inputs)
        memory = rest[0] if memory_size else memory
        np.testing.assert_allclose(action, policy.act(observation), atol=2e-5)
    assert [value.name for value in run.get_outputs()] == (["action", "next_memory"] if memory_size else ["action"])
    header = json.loads(run.get_modelmeta().custom_metadata_map[METADATA])
    assert header["task"] == task.to_json() and header["checkpoint"] == load_checkpoint(checkpoint).digest


@pytest.mark.parametrize("architecture", ACTORS, ids=lambda a: f"{a.kind}-{a.recurrent}")
def test_actors_act_alike(architecture: ActorArchitecture, tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "policy.safetensors"
    tensors = {name: values + 0 for name, values in TorchActor(architecture).tensors().items()}
    tensors["head.weight"] = (10 * tensors["head.weight"]).astype(np.float32)
    save_checkpoint(path, task=INSERTION, architecture=architecture, tensors=tensors, training={})
    seen = [rng.normal(0, 1, (5, *architecture.observation_shape)).astype(np.float32) for _ in range(4)]
    check_equal_actions(path, INSERTION, seen, architecture.recurrent)


@pytest.mark.parametrize(
    ("task", "mirror"), [(INSERTION, ("x", "y")), (insertion_task(CUBOID, misalignment=(3e-3, 3e-3, 0.1)), ("x",))]
)
def test_the_insertion_policy_acts_alike(task: InsertionTask, mirror: tuple[str, ...], tmp_path: Path) -> None:
    architecture = PolynomialGRU(degree=1, units=24, head=12, mirror=mirror)
    rng, path = np.random.default_rng(1), tmp_path / "policy.safetensors"
    values = {name: rng.normal(0, 0.4, shape) for name, shape in architecture.tensor_shapes(task).items()}
    values["basis"] = polynomial_basis(task.grid, architecture.degree)
    values["scale"] = np.full(architecture.features(task), 0.7)
    save_checkpoint(path, task=task, architecture=architecture, tensors=values, training={})
    check_equal_actions(path, task, [images(6, seed=i) for i in range(5)], 24 + 8)


def test_the_command_exports_the_shipped_policy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnx"), pytest.importorskip("onnxscript")
    model = tmp_path / "made" / "policy.onnx"
    assert main(["export", str(default_checkpoint()), "--out", str(model), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["model"] == str(model)
    (one,), policy = images(1), load_network(default_checkpoint(), task=INSERTION).batch_policy(1)
    action, _ = session(model).run(None, {"observation": one[None], "memory": np.zeros((1, 104), np.float32)})
    np.testing.assert_allclose(action, policy.act(one[None]), atol=2e-5)


def test_a_checkpoint_is_never_overwritten_by_its_model(tmp_path: Path) -> None:
    for name in ("policy.safetensors", "policy.onnx"):
        checkpoint = tmp_path / name
        checkpoint.write_bytes(default_checkpoint().read_bytes())
        with pytest.raises(UsageError, match=r"must be \.onnx|is the checkpoint"):
            export(checkpoint, checkpoint)
        assert checkpoint.read_bytes() == default_checkpoint().read_bytes()


def test_what_cannot_be_exported_gives_a_message_of_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    former = default_checkpoint().with_name("insertion_ppo.safetensors")
    with pytest.raises(UsageError, match="network polynomial-mlp cannot be exported"):
        export(former, tmp_path / "a.onnx")
    assert main(["export", str(tmp_path / "nothing"), "--out", str(tmp_path / "a.onnx")]) == 2
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert main(["export", str(default_checkpoint()), "--out", str(tmp_path / "a.onnx")]) == 2
    message = capsys.readouterr().err.splitlines()
    assert len(message) == 2 and "pip install 'gelflow[onnx]'" in message[1] and not (tmp_path / "a.onnx").exists()
