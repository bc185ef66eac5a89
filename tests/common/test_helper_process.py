"""Helper processes: the link to the parent, and how a failed helper is reported."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.common.processes import is_running

from gelflow.helper_process import HelperProcess, Messages


def pair() -> tuple[Messages, socket.socket]:
    ours, theirs = socket.socketpair()
    return Messages(ours), theirs


def test_values_split_across_packets_arrive_whole() -> None:
    messages, other = pair()
    data = b"".join(json.dumps(value).encode() + b"\n" for value in ({"a": [1.5, None]}, "x", 3))
    seen = []
    for i in range(len(data)):
        other.send(data[i : i + 1])
        seen += messages.read()
    assert seen == [{"a": [1.5, None]}, "x", 3]
    assert not messages.closed
    other.close()
    assert messages.read() == []
    assert messages.closed


def test_numbers_keep_every_bit_and_nan_stays_nan() -> None:
    ours, theirs = pair()
    other = Messages(theirs)
    ours.send([0.1 + 0.2, 1e-300, float("nan"), float("inf")])
    a, b, c, d = other.read()[0]
    assert (a, b, d) == (0.1 + 0.2, 1e-300, float("inf"))
    assert c != c


def test_sending_to_a_peer_that_reads_nothing_times_out() -> None:
    messages, other = pair()
    with pytest.raises(TimeoutError, match="read nothing for"):
        for _ in range(10_000):
            messages.send("x" * 1000, limit=0.05)
    other.close()
    with pytest.raises(OSError, match=r"."):
        messages.send("anybody?")


def test_waiting_for_a_value() -> None:
    messages, other = pair()
    with pytest.raises(TimeoutError, match=r"sent nothing for 0\.05 s"):
        messages.wait(0.05)
    other.send(b"1\n2\n")
    assert messages.wait(5.0) == [1, 2]
    other.close()
    assert messages.wait(5.0) == [] and messages.closed


def test_closing_reaches_the_peer_while_a_thread_waits() -> None:
    messages, other = pair()
    waiting = os.dup(messages.fileno())  # as `select` in another thread, which keeps the socket open
    messages.close()
    other.settimeout(20)
    assert other.recv(1) == b""
    os.close(waiting)
    other.close()


def test_exit_reason_of_a_helper_that_fails() -> None:
    helper = HelperProcess.start("gelflow.there_is_no_such_module", {})
    try:
        assert "exit status 1: " in (words := helper.exit_reason())
        assert "No module named gelflow.there_is_no_such_module" in words
        assert "\n" not in words
        assert Path(sys.executable).name in words
    finally:
        helper.close()


POOL = """
import os, time
from gelflow.helper_process import worker_pool

if __name__ == "__main__":
    with worker_pool(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        jobs = [pool.submit(time.sleep, 600) for _ in range(3)]
        jobs[0].result()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_parent(number: signal.Signals, tmp_path: Path) -> None:
    (tmp_path / "pool.py").write_text(POOL)
    parent = subprocess.Popen(
        [sys.executable, str(tmp_path / "pool.py")], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    assert is_running(worker)
    parent.send_signal(number)
    parent.wait(30)
    parent.stdout.close()
    end = time.monotonic() + 30
    while is_running(worker) and time.monotonic() < end:
        time.sleep(0.05)
    assert not is_running(worker)


def test_a_helper_imports_no_module_of_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "argparse.py").write_text("raise SystemExit('a file of the working folder')\n")
    monkeypatch.chdir(tmp_path)
    helper = HelperProcess.start("argparse", {})
    end = time.monotonic() + 30
    while helper.running:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert "a file of the working folder" not in helper.exit_reason()
    helper.close()
