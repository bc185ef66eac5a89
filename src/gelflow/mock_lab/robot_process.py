"""`gelflow mock` as a separate process, and requests to its side channel with the true state of the cell."""

import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from gelflow.errors import PeerError, PeerRefused

_START_LIMIT = 60.0  # of the mock robot [s, wall]
_STOP_LIMIT = 10.0  # [s, wall]
_REFUSED = 2  # exit code of `gelflow mock` for wrong options


@contextlib.contextmanager
def mock_robot(*, factor: float, seed: int, preset: str | None = None, **more: object) -> Iterator[tuple[Path, str]]:
    """Run a mock robot in a separate process; yields its lab file and the URL of its true state.

    `more` are further options of `gelflow mock`, by name; None omits one. Raises PeerError with the process's last
    line of standard error when it does not start, PeerRefused when that line is a refusal of its options.
    """
    truth_port = free_port(socket.SOCK_STREAM)
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as errors:
        lab = Path(folder) / "lab.toml"
        options: dict[str, object] = {
            "--out": lab,
            "--factor": factor,
            "--seed": seed,
            "--truth-port": truth_port,
            "--egm-port": free_port(socket.SOCK_DGRAM),
        }
        options |= {f"--{name}": value for name, value in {"preset": preset, **more}.items() if value is not None}
        process = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "gelflow.cli",
                "mock",
                "--attached",
                *(str(word) for pair in options.items() for word in pair),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,  # signals of the terminal end the run first, and the mock robot after it
        )
        try:
            _await_file(lab, process, errors)
            yield lab, f"http://127.0.0.1:{truth_port}/truth"
        finally:
            assert process.stdin is not None
            process.stdin.close()  # with --attached the process ends when its standard input closes
            try:
                process.wait(_STOP_LIMIT)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def true_state(url: str) -> dict[str, Any]:
    """The true state of the simulated cell. Raises PeerError when the mock robot does not answer."""
    try:
        with urllib.request.urlopen(url, timeout=10) as answer:
            return dict(json.load(answer))
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise PeerError(f"the mock robot does not answer at {url}: {error}") from error


def _await_file(path: Path, process: subprocess.Popen[bytes], errors: IO[bytes]) -> None:
    end = time.monotonic() + _START_LIMIT
    while not path.exists():
        if process.poll() is not None or time.monotonic() > end:
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines()
            kind = PeerRefused if process.returncode == _REFUSED else PeerError
            raise kind(f"the mock robot did not start: {lines[-1] if lines else 'no reason given'}")
        time.sleep(0.05)


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
