"""The page of `--view`: a run in the browser while it happens."""

import argparse
import contextlib
import importlib.util
from collections.abc import Callable, Iterator

from gelflow.cli.output import Output
from gelflow.errors import UsageError
from gelflow.real.runner.motion_executor import MotionExecutor
from gelflow.view.live.live_view import LiveView


@contextlib.contextmanager
def live_page(args: argparse.Namespace, output: Output) -> Iterator[LiveView | None]:
    """Serve the page in this block; None without `--view`. Raises UsageError when it cannot be served."""
    if not args.view:
        yield None
        return
    if importlib.util.find_spec("viser") is None:
        raise UsageError("--view needs viser; install it with: pip install 'gelflow[view]'")
    with LiveView(host=args.host, port=args.port, on_lost=lambda line: output.text(f"warning: {line}")) as view:
        output.text(f"open {view.url} in a browser; its red button stops the arm")
        yield view


def motion_observer(view: LiveView | None, at_once: list[Callable[[], None]]) -> Callable[[MotionExecutor], None]:
    """For `RunPlan.on_motion`: signals hold the arm at once, and the button of the page stops it."""

    def observe(motion: MotionExecutor) -> None:
        at_once.append(motion.hold)
        if view is not None:
            view.watch(motion.request_stop)

    return observe
