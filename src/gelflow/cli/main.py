"""Entry point of the `gelflow` command: runs a sub-command and prints any gelflow error as one line.

A sub-command is a module below `gelflow.cli.commands` with `configure(parser)` and `run(args) -> int`. Only the
requested one is imported, so that `gelflow --help` loads neither torch nor OpenCV.
"""

import argparse
import contextlib
import errno
import importlib
import io
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from types import ModuleType

from gelflow import __version__
from gelflow.cli.exit_codes import ERROR, INTERRUPTED, NEGATIVE_RESULT, SIGNALLED
from gelflow.errors import GelflowError
from gelflow.interrupts import Interrupted

# Command → description in one line. Its module is gelflow.cli.commands.<command>, with _ for -, see `_FOLDERS`.
COMMANDS = {
    "train": "train a policy in simulation",
    "sweep": "train many configurations and seeds on this machine, a Ray cluster or SLURM",
    "eval": "measure the success of a policy in simulation, of an oracle and of random actions",
    "reproduce": "train and evaluate the experiments of the paper again, beside its figures",
    "export": "export a policy as an ONNX model",
    "track": "track markers in tactile images: a folder, a video, a stream or a camera",
    "calibrate-camera": "calibrate a camera in millimetres from one image of the gel at rest",
    "calibrate-gel": "calibrate the stiffness of a gel with measured forces",
    "run": "run the insertion policy on the robot or on the mock robot",
    "robot": "at set-up and after a stop: state of the devices; home, open, acknowledge, jog",
    "calibrate": "fit the simulator to recorded insertions: parameters with intervals, and a report",
    "replay": "recompute the decisions of a recorded session and compare them",
    "recover": "copy the complete records of an unfinished or damaged session",
    "mock": "start the mock robot: gripper, arm and two cameras with their network protocols",
    "render": "render gel images with known marker positions",
    "render-scene": "draw a scene or a rollout of it: a picture or a film with bodies, contact forces and pads",
    "view": "look at a scene, recorded sessions or a training in the browser",
    "bench": "measure the speed of the simulator and the tracker",
    "tradeoff": "measure speed and error of a scene for many settings and for the presets",
    "describe": "describe a scene: model, omissions, size, and time of a step",
    "soak": "insert parts with the mock robot under random faults, and count violated rules",
    "demo": "insert five parts with the mock robot, with pictures and a recorded session",
}

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)

# Commands whose modules are in a folder of gelflow.cli.commands.
_FOLDERS = {
    **dict.fromkeys(("train", "sweep", "eval", "reproduce", "export"), "training"),
    **dict.fromkeys(("render", "render-scene", "view"), "pictures"),
}


def command_module(name: str) -> ModuleType:
    """Imports the module of a command."""
    path = [*([_FOLDERS[name]] if name in _FOLDERS else []), name.replace("-", "_")]
    return importlib.import_module(".".join(["gelflow.cli.commands", *path]))


def _warning_format() -> Callable[..., str]:
    """Formats a warning as one line, without the line of code that raised it, and its repetitions as nothing."""
    printed: set[str] = set()

    def one_line(message: Warning | str, *_: object, **__: object) -> str:
        text = f"gelflow: {message}\n"
        if text in printed:
            return ""
        printed.add(text)
        return text

    return one_line


def _prepare_streams() -> None:
    """Let no text fail to be printed.

    A character that the encoding of the terminal lacks becomes "?"; text for a closed stream is discarded.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed, as by `>&-`
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - until the end of the process
        elif isinstance(stream, io.TextIOWrapper):
            limited = not stream.encoding.lower().startswith("utf")
            if stream.errors == "strict" or (limited and stream.errors == "surrogateescape"):
                stream.reconfigure(errors="replace")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one sub-command and return its exit code (see `gelflow.cli.exit_codes`)."""
    _prepare_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    requested = next((a for a in arguments if not a.startswith("-")), "")
    try:
        return _run(arguments, requested)
    except KeyboardInterrupt:  # also during the imports of a command
        print(f"gelflow {requested}".rstrip() + ": interrupted", file=sys.stderr)
        return INTERRUPTED


def _run(arguments: Sequence[str], requested: str) -> int:
    """Run the sub-command `requested` and print any gelflow error as one line."""
    parser = argparse.ArgumentParser(prog="gelflow", description="Sim-to-real for tactile manipulation.")
    parser.add_argument("--version", action="version", version=f"gelflow {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    module = None
    for name, text in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        if name == requested:
            module = command_module(name)
            module.configure(sub)
    args = parser.parse_args(arguments)
    assert module is not None
    warnings.formatwarning = _warning_format()
    try:
        status = int(module.run(args))
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader has closed the pipe, as in `gelflow … | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        return NEGATIVE_RESULT
    except MemoryError:
        print(f"gelflow {args.command}: not enough memory; give smaller numbers", file=sys.stderr)
        return ERROR
    except GelflowError as error:
        # Notes are later errors and hints; the error stays one line.
        text = "; ".join([str(error), *getattr(error, "__notes__", [])])
        print(f"gelflow {args.command}: {text}", file=sys.stderr)
        return ERROR
    except OSError as error:
        full = error.errno in _DISK_FULL
        if not full and error.filename is None:
            raise
        name = "" if error.filename is None else f" {error.filename}"
        verb = "write" if full else "use"
        print(f"gelflow {args.command}: cannot {verb}{name}: {error.strerror}", file=sys.stderr)
        return ERROR
    except Interrupted as interrupt:
        with contextlib.suppress(OSError):  # after SIGHUP the terminal is gone
            print(f"gelflow {args.command}: ended by {interrupt}", file=sys.stderr)
        return SIGNALLED + interrupt.number
