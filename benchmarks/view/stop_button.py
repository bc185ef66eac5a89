"""Time from a press of the stop button in a browser to the first constant reference that the mock arm receives.

    python -m benchmarks.view.stop_button --presses 5

Each press stops one run at robot time 1 while the arm moves. The press is timed in the browser (headless Chromium,
which draws by software). A relay between the arm and its driver reads the references on the wire: the stop has arrived
with the first one from which on the position does not change.
"""

import argparse
import math
import socket
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tests.view.browser import Browser, browser

from gelflow.errors import SafetyError
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.mock_lab.lab import lab_for
from gelflow.policies.checkpoint import default_checkpoint, load_policy
from gelflow.real.egm.codec import decode_sensor
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.real.runner.run_plan import RunPlan, run_insertions
from gelflow.task import INSERTION
from gelflow.view.live.live_view import LiveView

_PRESS = """
const button = [...document.querySelectorAll('button')].filter(b => b.innerText.trim() === 'STOP THE ARM')[0];
const now = performance.timeOrigin + performance.now();
button.click();
return now / 1000;
"""
_MOVING = 50  # references that changed one after the other, before the button is pressed
_LIMIT = 180.0  # [s]


class Relay:
    """Passes the datagrams between the mock arm and its driver on, and keeps the references with their times."""

    def __init__(self) -> None:
        self._arm, self._driver = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._arm.bind(("127.0.0.1", 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.driver_port = int(probe.getsockname()[1])
        self.port = int(self._arm.getsockname()[1])  # to which the arm sends
        self._sender: Any = None
        self.changed = 0  # references since the last one that was equal to the one before
        self.last_change = math.nan  # time of the newest reference that differs from the one before [s]
        for receive in (self._from_arm, self._from_driver):
            threading.Thread(target=receive, daemon=True).start()

    def _from_arm(self) -> None:
        while True:
            data, self._sender = self._arm.recvfrom(4096)
            self._driver.sendto(data, ("127.0.0.1", self.driver_port))

    def _from_driver(self) -> None:
        before: Any = None
        while True:
            try:
                data = self._driver.recv(4096)
            except OSError:  # nobody listens yet
                time.sleep(0.001)
                continue
            now = time.time()
            self._arm.sendto(data, self._sender)
            reference = decode_sensor(data)
            present = reference.position, reference.quaternion
            self.changed = self.changed + 1 if present != before else 0
            if present != before:
                self.last_change = now
            before = present


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presses", type=int, default=5)
    args = parser.parse_args()
    with browser() as window:
        taken = [press(window, number) for number in range(args.presses)]
    for name, times in zip(
        ("from the press to the run", "from the run to the arm", "whole"), zip(*taken, strict=True), strict=True
    ):
        print(
            f"{name}: smallest {1e3 * min(times):.0f} ms, median {1e3 * float(np.median(times)):.0f} ms, "
            f"largest {1e3 * max(times):.0f} ms of {len(times)}"
        )


def press(window: Browser, number: int) -> tuple[float, float, float]:
    """One run that is stopped; times from the press to the run, from there to the arm, and the whole [s]."""
    relay, ended = Relay(), threading.Event()
    reached: list[float] = []  # times at which the run received the stop [s]
    with (
        tempfile.TemporaryDirectory() as folder,
        LiveView(host="127.0.0.1", port=0) as view,
        MockRobot(1.0, MockRobotConfig(egm_port=relay.port)) as robot,
    ):
        lab = lab_for(robot)
        lab = replace(lab, arm=replace(lab.arm, egm_port=relay.driver_port))
        session = Path(folder) / "session.mcap"

        def on_motion(motion: MotionExecutor) -> None:
            def stop(reason: str) -> None:
                reached.append(time.time())
                motion.request_stop(reason)

            view.watch(stop)

        plan = RunPlan(
            lab=lab, policy=load_policy(default_checkpoint(), task=INSERTION), task=INSERTION,
            session=session, on_motion=on_motion,
        )  # fmt: skip
        view.show(session)
        window.open(view.url)

        def run() -> None:
            try:
                run_insertions(plan)
            except SafetyError as error:
                print(f"{number + 1}: {error}", flush=True)
            finally:
                ended.set()

        threading.Thread(target=run, daemon=True).start()
        wait(lambda: relay.changed > _MOVING, ended)
        pressed = float(window.driver.execute_script(_PRESS))
        ended.wait(_LIMIT)
        stopped = max(relay.last_change, reached[0])  # no change after it: the arm had the stop at once
        taken = reached[0] - pressed, stopped - reached[0], stopped - pressed
        print(f"{number + 1}: " + " + ".join(f"{1e3 * x:.0f}" for x in taken[:2]) + " ms", flush=True)
        return taken


def wait(ready: Any, ended: threading.Event) -> None:
    """Wait until the arm moves."""
    deadline = time.monotonic() + _LIMIT
    while not ready():
        if ended.is_set() or time.monotonic() > deadline:
            raise SystemExit("the arm did not move")
        time.sleep(0.005)


if __name__ == "__main__":
    main()
