"""Hints after a stopped run or action: the command with which to continue."""

import re
import shlex
from pathlib import Path

_COMMAND = re.compile(r"gelflow robot (?:acknowledge|home|jog z \+10|open)(?! --lab)")


def hint_after_stop(error: str, lab: Path, *, moved: bool) -> str:
    """A hint for the error of a run with the lab file `lab`; empty when nothing has to be done at the robot.

    `moved` states that motion may have begun: the gripper may be above or in the hole, with a part.
    """
    for words, action in (
        (("FAST_STOP", "_FAULT"), "acknowledge the gripper's fault with: gelflow robot acknowledge"),
        (("not homed", "not referenced"), "home the gripper with: gelflow robot home"),
        (("holds a part", "part may be held", "a part is held"), "open the gripper with: gelflow robot open"),
    ):
        if any(word in error for word in words):
            return with_lab_option(action, lab)
    if moved:
        return with_lab_option("raise the gripper with: gelflow robot jog z +10", lab)
    return "check the cable of the gripper, then start again" if "BAD_CHECKSUM" in error else ""


def with_lab_option(text: str, lab: Path) -> str:
    """The text, with the option --lab in each command of `gelflow robot`, so that a user can copy it."""
    return _COMMAND.sub(lambda command: f"{command[0]} --lab {shlex.quote(str(lab))}", text)
