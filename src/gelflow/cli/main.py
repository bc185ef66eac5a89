"""Entry point of the `gelflow` command: finds the sub-command, prints any of our errors as one line.

A sub-command is a module in this folder with `configure(parser)` and `run(args) -> int`; it is imported only when
asked for, so that `gelflow --help` needs neither torch nor OpenCV.
"""

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from gelflow import __version__
from gelflow.errors import GelflowError

# command → (what it does in one line). The module is gelflow.cli.commands.<command>, with _ for -.
COMMANDS = {
    "train": "train a policy in simulation",
    "eval": "success of a policy in simulation, beside random actions",
    "track": "track markers on tactile images: a folder, a video, a stream or a camera",
    "calibrate-camera": "millimetres in a camera's images, from one image of the gel at rest",
    "run": "run the insertion policy on the robot, or on the mock robot",
    "replay": "run a recorded session through tracker and policy again and compare the decisions",
    "recover": "salvage what a killed recorder left behind",
    "mock": "start the mock robot: gripper, arm and two cameras on the wire",
    "render": "draw images of a gel with known truth: what tracking is tried on",
    "bench": "measure speed",
    "tradeoff": "what accuracy costs on a scene: settings by speed and error, and the presets among them",
    "describe": "what a scene models, what it leaves out and why, its size, and where a step's time goes",
    "demo": "the main job on the mock robot: five insertions, pictures, a session",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one sub-command; returns its exit status (0 done, 1 a negative result, 2 an error, 130 interrupted)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    chosen = next((a for a in arguments if not a.startswith("-")), None)
    parser = argparse.ArgumentParser(prog="gelflow", description="Sim-to-real for tactile manipulation.")
    parser.add_argument("--version", action="version", version=f"gelflow {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    module = None
    for name, text in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name == chosen:
            module = importlib.import_module(f"gelflow.cli.commands.{name.replace('-', '_')}")
            module.configure(sub)
    args = parser.parse_args(arguments)
    assert module is not None
    try:
        status = int(module.run(args))
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader has seen enough, as in `gelflow … | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what Python still wants to flush
        return 1  # as rich's console has it
    except GelflowError as error:
        print(f"gelflow {args.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"gelflow {args.command}: interrupted", file=sys.stderr)
        return 130
