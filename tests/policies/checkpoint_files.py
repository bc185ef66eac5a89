"""Checkpoints with a changed header, for tests."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import safetensors.numpy


def rewrite(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Rewrites a checkpoint with a changed header, without its checksum, as earlier versions wrote it."""
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["gelflow"])
    del header["header_sha256"]
    change(header)
    path.write_bytes(safetensors.numpy.save(safetensors.numpy.load(data), metadata={"gelflow": json.dumps(header)}))
