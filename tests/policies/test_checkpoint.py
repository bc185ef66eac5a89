"""A damaged checkpoint is refused, wherever the damage is."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.policies.checkpoint_files import rewrite

from gelflow.errors import UsageError
from gelflow.policies.checkpoint import Checkpoint, load_checkpoint, load_policy, save_checkpoint, shipped_checkpoints
from gelflow.policies.networks.polynomial_features import polynomial_basis
from gelflow.policies.networks.polynomial_gru import PolynomialGRU
from gelflow.task import INSERTION

SMALL = PolynomialGRU(degree=0, units=4, head=3)


def tensors() -> dict[str, NDArray[Any]]:
    """A network with random weights."""
    rng = np.random.default_rng(0)
    values = {name: rng.normal(0, 0.3, shape) for name, shape in SMALL.tensor_shapes(INSERTION).items()}
    return values | {"basis": polynomial_basis(INSERTION.grid, SMALL.degree), "scale": np.ones(4)}


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "policy.safetensors"
    training = {"command": ["train"], "validation": {"reward": float("nan")}, "counts": {2: 1, 10: 2}}
    save_checkpoint(path, task=INSERTION, architecture=SMALL, tensors=tensors(), training=training)
    return path


def contents(checkpoint: Checkpoint) -> str:
    """Everything but the digest of the file, as text: NaN is equal to itself."""
    values = {name: (array.dtype, array.tolist()) for name, array in sorted(checkpoint.tensors.items())}
    return repr(dataclasses.replace(checkpoint, tensors=values, digest=""))  # type: ignore[arg-type]


def test_a_changed_header_is_refused(stored: Path) -> None:
    data = stored.read_bytes()
    changed = data.replace(rb"\"reach\": [0.008", rb"\"reach\": [0.018", 1)
    assert len(changed) == len(data) and changed != data
    stored.write_bytes(changed)
    with pytest.raises(UsageError, match=r"damaged checkpoint \(ValueError: checksum mismatch of the header\)"):
        load_policy(stored)


def test_no_changed_byte_changes_the_contents(stored: Path, tmp_path: Path) -> None:
    data, original = stored.read_bytes(), contents(load_checkpoint(stored))
    damaged = tmp_path / "damaged.safetensors"
    header = 8 + int.from_bytes(data[:8], "little")
    for position, change in [(i, change) for i in range(0, header, 7) for change in (0x01, 0x0F)]:
        damaged.write_bytes(data[:position] + bytes([data[position] ^ change]) + data[position + 1 :])
        try:
            read = load_checkpoint(damaged)
        except UsageError as error:
            assert "\n" not in str(error)
        else:  # the name of the checksum itself
            assert contents(read) == original


def test_tensors_of_another_type_are_refused(stored: Path) -> None:
    stored.write_bytes(stored.read_bytes().replace(b'"dtype":"F32"', b'"dtype":"I32"', 1))
    with pytest.raises(UsageError, match=r"damaged checkpoint .*tensors of type int32"):
        load_policy(stored)


def test_a_checkpoint_without_checksum_of_its_header_is_read(stored: Path) -> None:
    expected = contents(load_checkpoint(stored))
    rewrite(stored, lambda header: None)
    assert contents(load_checkpoint(stored)) == expected
    assert all(load_checkpoint(path).tensors for path in shipped_checkpoints())


@pytest.mark.parametrize(
    ("architecture", "message"),
    [
        ([], "the architecture of the network must be a table, got list"),
        (None, "must be a table, got NoneType"),
        ({**SMALL.to_json(), "reach": [float("nan"), 8e-3, 0.2]}, "PolynomialGRU: reach must be .*got \\(nan, 0.008"),
        ({**SMALL.to_json(), "reach": [8e-3, float("inf"), 0.2]}, "reach must be"),
        ({**SMALL.to_json(), "degree": float("nan")}, "degree must be a whole number of at least 0, got nan"),
        ({**SMALL.to_json(), "units": 4.0}, "units must be a whole number"),
    ],
)
def test_an_impossible_architecture_is_refused(stored: Path, architecture: Any, message: str) -> None:
    rewrite(stored, lambda header: header.update(architecture=architecture))
    with pytest.raises(UsageError, match=message) as error_info:
        load_policy(stored)
    assert "\n" not in str(error_info.value) and str(stored) in str(error_info.value)


def test_a_path_may_be_text(stored: Path) -> None:
    assert load_checkpoint(str(stored)).architecture == SMALL
