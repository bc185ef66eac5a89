"""Steps per second of a loop of one's own with `viewer.update()`: without a viewer, without and with a browser.

    python -m benchmarks.view.loop_rate

The browser is headless Chromium, which draws by software on the same computer.
"""

import argparse
import contextlib
import time
from collections.abc import Callable

from rich.console import Console
from rich.table import Table
from tests.view.browser import browser

import gelflow.sim as gs
import gelflow.view
from gelflow.sim.scene.start_controls import holding_controls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["rolling", "insertion", "dclaw"])
    parser.add_argument("--num-envs", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of each loop")
    args = parser.parse_args()
    table = Table("scene", "no viewer", "no browser", "browser", title=f"Steps/s, {args.num_envs} environments")
    for scene in args.scenes:
        sim = gs.Simulator(gs.load_scene(scene), num_envs=args.num_envs)
        rates = [rate(sim, lambda: None, args.seconds)]
        for opens in (False, True):
            with gelflow.view.open(sim, port=0) as viewer, contextlib.ExitStack() as stack:
                if opens:
                    stack.enter_context(browser()).open(viewer.url)
                rates.append(rate(sim, viewer.update, args.seconds))
        table.add_row(scene, *(f"{steps:.0f}" for steps in rates))
    Console(width=80, markup=False).print(table)


def rate(sim: gs.Simulator, update: Callable[[], None], seconds: float) -> float:
    """Steps per second from the start of the scene, which the controls hold."""
    sim.reset()
    controls = holding_controls(sim.scene)
    begun, steps = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - begun) < seconds:
        sim.step(controls)
        update()
        steps += 1
    return steps / elapsed


if __name__ == "__main__":
    main()
