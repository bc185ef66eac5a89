"""`gelflow demo`: the mock robot and the insertion policy, end to end on the wire: table, pictures, a session."""

import argparse
import contextlib
import json
import math
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from gelflow.cli.presets import PRESET_HELP
from gelflow.errors import GelflowError, PeerError, UsageError
from gelflow.task import INSERTION

if TYPE_CHECKING:
    from gelflow.policies.networks import NetworkPolicy
    from gelflow.protocols import Policy
    from gelflow.real.runner.insertion_runner import Attempt, Insertion

_START_LIMIT = 60.0  # for the mock robot to be up [s, wall]
_TELL_WAIT = 0.1  # of the wall time, in which the simulation did not keep up
_COMPARED = 100  # parts in simulation alone


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--insertions", type=int, default=5, metavar="N", help="how many parts (default 5)")
    parser.add_argument("--factor", type=float, default=5.0, help="robot time over wall time (default 5)")
    parser.add_argument("--seed", type=int, default=1, help="of the first part's misalignment (default 1)")
    parser.add_argument("--preset", metavar="NAME", help=PRESET_HELP)
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="the policy; default: gelflow's own")
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="folder (default out/demo)")
    parser.add_argument("--no-real-time", action="store_true", help="leave out the one insertion at factor 1")


def run(args: argparse.Namespace) -> int:
    from gelflow.policies.checkpoint import default_checkpoint, load_policy

    if args.insertions < 1:
        raise UsageError(f"--insertions must be at least 1, got {args.insertions}")
    # The default of 5 ms lets a computing thread keep those waiting that watch gripper and cameras.
    sys.setswitchinterval(5e-4)
    console = Console(highlight=False)
    checkpoint = args.checkpoint or default_checkpoint()
    policy = load_policy(checkpoint, task=INSERTION)
    _clear(args.out)
    title = f"Insertions on the mock robot, {args.factor:g} times as fast as the clock"
    done = demonstrate(
        console,
        policy,
        checkpoint,
        out=args.out,
        count=args.insertions,
        factor=args.factor,
        seed=args.seed,
        preset=args.preset,
        title=title,
    )
    console.print(table(done, title))
    if not args.no_real_time and done.trouble is None:
        real = demonstrate(
            console, policy, checkpoint, out=args.out, count=1, factor=1.0, seed=args.seed + args.insertions,
            preset=args.preset, title="One more in real time (factor 1)", name="session-real-time",
        )  # fmt: skip
        console.print(table(real, "One more in real time (factor 1)"))
        done = replace(done, trouble=real.trouble)
    session = args.out / "session.mcap"
    said = sum(one.result.inserted for one in done.shown)
    true = sum(one.truth["inserted"] for one in done.shown)
    count = len(done.shown)
    console.print(
        f"inserted: {said} of {count} as the robot says, {true} of {count} in truth; {done.wall:.0f} s in all."
    )
    with console.status("the same policy in simulation alone"):
        console.print(in_simulation(policy, preset=args.preset), soft_wrap=True)
    console.print(f"pictures of what the policy saw: {args.out}/insertion-*.png", soft_wrap=True)
    console.print(f"the session is {session}; make its decisions again with:", soft_wrap=True)
    console.print(f"  gelflow replay {session}", soft_wrap=True)
    if done.trouble is not None:
        raise done.trouble
    return 0


@dataclass(frozen=True)
class Shown:
    """One insertion, as the robot saw it and as it was."""

    result: "Insertion"
    truth: dict[str, Any]  # of its part: see hardware_mocks/simulated_cell/cell.py


@dataclass(frozen=True)
class Demonstration:
    """All insertions of one session."""

    shown: list[Shown]
    wall: float  # [s]
    slack: str  # empty, or how fast the simulation was instead
    trouble: GelflowError | None  # what ended it before all parts were tried


def demonstrate(
    console: Console,
    policy: "Policy",
    checkpoint: Path,
    *,
    out: Path,
    count: int,
    factor: float,
    seed: int,
    preset: str | None = None,
    title: str,
    name: str = "session",
) -> Demonstration:
    """Start a mock robot, insert `count` parts through its wires, record, draw; the truth is asked beside the wires."""
    from gelflow.cli.commands.run import ATTEMPT_HEADER, attempt_line
    from gelflow.cli.pictures import draw_insertion
    from gelflow.real.runner.lab_file import load_lab
    from gelflow.real.runner.run_plan import RunPlan, run_insertions

    begun = time.monotonic()
    shown: list[Shown] = []
    with mock_robot(factor=factor, seed=seed, preset=preset) as (lab_path, truth_url):
        lab = load_lab(lab_path)
        console.print(f"[bold]{title}[/]\n{lab.gripper.address}, UDP {lab.arm.egm_port}, two MJPEG cameras")
        console.print(ATTEMPT_HEADER, markup=False)

        seeds: dict[int, int] = {}

        def tell(number: int, attempt: "Attempt") -> None:
            seeds[number] = ask(truth_url)["parts"][-1]["seed"]
            console.print(attempt_line(number, attempt), markup=False)

        def finish(result: "Insertion") -> None:
            # The hand may hold out the next part already.
            parts = {part["seed"]: part for part in ask(truth_url)["parts"]}
            shown.append(Shown(result, parts[seeds.get(result.number, max(parts))]))
            console.print(f"{result.number + 1:6d}  {result.outcome} after {result.duration:.0f} s of the robot's time")

        plan = RunPlan(
            lab=lab,
            policy=policy,
            task=INSERTION,
            session=out / f"{name}.mcap",
            checkpoint=checkpoint,
            insertions=count,
            on_attempt=tell,
            on_insertion=finish,
        )
        trouble = None
        try:
            run_insertions(plan)
        except GelflowError as error:
            trouble = error  # what was done until then is shown first
        truth = ask(truth_url)
    wall = time.monotonic() - begun
    mounts = (lab.cameras.left.mount, lab.cameras.right.mount)
    prefix = "insertion" if name == "session" else "insertion-real-time"
    for one in shown:
        draw_insertion(one.result, mounts, INSERTION, out / f"{prefix}-{one.result.number + 1}.png")
    waited = truth["waited"] / factor
    slack = ""
    if waited > _TELL_WAIT * wall:
        real = factor * (1 - waited / wall)
        slack = f"this computer managed {real:.1f} times as fast as the clock"
    return Demonstration(shown, wall, slack, trouble)


def table(done: Demonstration, title: str) -> Table:
    """Misalignment, attempts, the robot's view, the truth, time."""
    view = Table(title=title, caption=done.slack or None)
    view.add_column("part", justify="right")
    view.add_column("misalignment\nx, y [mm], yaw [°]", justify="right")
    view.add_column("attempts", justify="right")
    view.add_column("robot says")
    view.add_column("truth")
    view.add_column("time [s]\nrobot", justify="right")
    for one in done.shown:
        x, y, yaw = one.truth["misalignment"]
        inside = one.truth["inserted"]
        view.add_row(
            str(one.result.number + 1),
            f"{1e3 * x:+.1f}, {1e3 * y:+.1f}, {math.degrees(yaw):+.1f}",
            str(len(one.result.attempts)),
            one.result.outcome,
            "inserted" if inside else "not inserted",
            f"{one.result.duration:.0f}",
            style=None if inside and one.result.inserted else "red",
        )
    return view


def in_simulation(policy: "NetworkPolicy", *, preset: str | None = None) -> str:
    """How the policy does without wires and cameras, and what luck would do: the figures that the demo's compare to."""
    from gelflow.policies.environment import make_insertion_env
    from gelflow.policies.evaluation import NetworkActor, RandomActor, evaluate

    attempts = make_insertion_env(_COMPARED, preset=preset)
    reach = policy.network.architecture.reach
    ways = (NetworkActor(policy.network, _COMPARED), RandomActor(reach, _COMPARED, 0))
    own, random = (evaluate("", way, attempts, episodes=_COMPARED, seed=1) for way in ways)
    return (
        f"in simulation alone, {_COMPARED} parts: this policy {own.success:.0%} in {own.attempts:.1f} attempts,"
        f" random corrections {random.success:.0%}."
    )


@contextlib.contextmanager
def mock_robot(*, factor: float, seed: int, preset: str | None = None) -> Iterator[tuple[Path, str]]:
    """A mock robot in a process of its own: its lab file, and where it tells the truth.

    Raises PeerError with its last words when it does not start.
    """
    truth_port = _free_port(socket.SOCK_STREAM)
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as words:
        lab = Path(folder) / "lab.toml"
        command = "import sys; from gelflow.cli.main import main; sys.exit(main(sys.argv[1:]))"
        options = {
            "--lab-out": lab, "--factor": factor, "--seed": seed, "--truth-port": truth_port,
            "--egm-port": _free_port(socket.SOCK_DGRAM),
        }  # fmt: skip
        if preset is not None:
            options["--preset"] = preset
        words_of = [str(word) for option in options.items() for word in option]
        process = subprocess.Popen(
            [sys.executable, "-c", command, "mock", "--attached", *words_of],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=words,
        )
        try:
            _await_file(lab, process, words)
            yield lab, f"http://127.0.0.1:{truth_port}/truth"
        finally:
            assert process.stdin is not None
            process.stdin.close()  # it ends when its input does
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def ask(url: str) -> dict[str, Any]:
    """The truth, from the mock's side channel. Raises PeerError when nobody answers."""
    try:
        with urllib.request.urlopen(url, timeout=10) as answer:
            return dict(json.load(answer))
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise PeerError(f"the mock robot does not tell the truth at {url}: {error}") from error


def _await_file(path: Path, process: subprocess.Popen[bytes], words: Any) -> None:
    end = time.monotonic() + _START_LIMIT
    while not path.exists():
        if process.poll() is not None or time.monotonic() > end:
            words.seek(0)
            lines = words.read().decode(errors="replace").strip().splitlines()
            raise PeerError(f"the mock robot did not start: {lines[-1] if lines else 'no reason given'}")
        time.sleep(0.05)


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _clear(out: Path) -> None:
    """A demonstration replaces the one before; only what a demonstration writes is removed."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for pattern in ("session*.mcap", "insertion-*.png"):
            for path in out.glob(pattern):
                path.unlink()
    except OSError as error:
        raise UsageError(f"cannot write to {out}: {error.strerror}; name another folder with --out") from error
