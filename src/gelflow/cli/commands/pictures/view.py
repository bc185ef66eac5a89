"""`gelflow view`: a page in the browser with a scene that can be moved, with sessions, or with the result of a run."""

import argparse
import contextlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from gelflow.cli.exit_codes import SUCCESS
from gelflow.cli.options import add_checkpoint, add_json, add_page_address, add_preset, check_at_least
from gelflow.cli.output import Output
from gelflow.errors import UsageError
from gelflow.session.decision_replay import Comparison
from gelflow.session.reader import SessionReader

_SCENE_ONLY = {"num_envs": 1, "env": 0, "preset": None}  # options and their defaults


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "shown", metavar="SCENE|SESSION|RUN", nargs="+",
        help="name of an included scene, or a TOML, MJCF or URDF file; one or two recorded sessions (.mcap); or the "
        "folder of a training or of gelflow eval --out",
    )  # fmt: skip
    parser.add_argument("--num-envs", type=int, default=1, metavar="N", help="environments (default %(default)s)")
    parser.add_argument(
        "--env", type=int, default=0, metavar="N", help="environment that is shown (default %(default)s)"
    )
    parser.add_argument(
        "--replay", action="store_true", help="of a session: replay its decisions first, and mark those that differ"
    )
    add_checkpoint(parser, default="the policy of the session")
    add_page_address(parser)
    add_preset(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    sessions = [name for name in args.shown if name.lower().endswith(".mcap")]
    if sessions and (len(sessions) < len(args.shown) or len(sessions) > 2):
        raise UsageError(f"name one scene, or one session or two, got {' '.join(args.shown)}")
    if not sessions and len(args.shown) > 1:
        raise UsageError(f"name one scene or one run, got {' '.join(args.shown)}")
    folder = "" if sessions else _run_folder(args.shown[0])
    for name, default in _SCENE_ONLY.items():
        if sessions and getattr(args, name) != default:
            raise UsageError(f"--{name.replace('_', '-')} is for scenes, and {sessions[0]} is a session")
        if folder and getattr(args, name) != default:
            raise UsageError(f"--{name.replace('_', '-')} is for scenes, and {folder} is a folder")
    if args.replay and len(sessions) != 1:
        raise UsageError("--replay needs one session, a file that ends with .mcap")
    if args.checkpoint is not None and not args.replay:
        raise UsageError("--checkpoint names the policy of --replay; add --replay")
    from gelflow.view.page import import_viser

    import_viser()
    if sessions:
        return _view_sessions(args, sessions)
    return _view_run(args) if folder else _view_scene(args)


def _run_folder(name: str) -> str:
    """The name if it is that of a folder to show, else "".

    A folder with the name of an included scene is shown only if it is a training or an evaluation.
    """
    folder = Path(name)
    if not name or not folder.is_dir():
        return ""
    from gelflow.policies.reports.saved_evaluation import is_evaluation
    from gelflow.policies.reports.watched_training import is_training
    from gelflow.sim.scene import scene_names

    return "" if name in scene_names() and not (is_training(folder) or is_evaluation(folder)) else name


def _view_run(args: argparse.Namespace) -> int:
    from gelflow.policies.reports.saved_evaluation import SavedEvaluation, is_evaluation
    from gelflow.policies.reports.watched_training import WatchedTraining
    from gelflow.view.training.training_page import TrainingPage

    folder = Path(args.shown[0])
    shown = SavedEvaluation(folder) if is_evaluation(folder) else WatchedTraining(folder)
    with TrainingPage(shown, host=args.host, port=args.port) as page:
        return _serve(args, page.url, page.run)


def _view_scene(args: argparse.Namespace) -> int:
    check_at_least(args, num_envs=1)
    from gelflow.sim.scene import load_scene
    from gelflow.sim.simulator import Simulator
    from gelflow.view.simulation_page import SimulationPage

    sim = Simulator(load_scene(args.shown[0], preset=args.preset), num_envs=args.num_envs)
    with SimulationPage(sim, env=args.env, host=args.host, port=args.port, controls=True) as page:
        return _serve(args, page.url, page.run)


def _view_sessions(args: argparse.Namespace, paths: Sequence[str]) -> int:
    from gelflow.view.session.recorded_session import RecordedSession
    from gelflow.view.session.session_page import SessionPage

    with contextlib.ExitStack() as stack:
        sessions = [stack.enter_context(RecordedSession(path)) for path in paths]
        comparisons = _replayed(sessions[0].reader, args.checkpoint) if args.replay else None
        page = stack.enter_context(SessionPage(sessions, comparisons=comparisons, host=args.host, port=args.port))
        return _serve(args, page.url, page.run)


def _replayed(session: SessionReader, checkpoint: Path | None) -> list[Comparison]:
    """The decisions of a session, recomputed."""
    from gelflow.cli.session_replay import recorded_pipeline, replay_with_progress
    from gelflow.session.messages import Damage

    return replay_with_progress(session, *recorded_pipeline(session.description(), checkpoint), damage=Damage())


def _serve(args: argparse.Namespace, url: str, serve: Callable[[], None]) -> int:
    output = Output(args.json)
    # Ctrl-C is the normal end from the first line on, which other programs wait for.
    with contextlib.suppress(KeyboardInterrupt):
        output.text(f"open {url} in a browser; Ctrl-C ends")
        output.result({"url": url})
        sys.stdout.flush()  # it goes on
        serve()
    return SUCCESS
