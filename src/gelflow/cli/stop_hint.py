"""Hint after a stopped run: the command with which to continue."""

import shlex
from pathlib import Path


def hint_after_stop(error: str, lab: Path, *, moved: bool) -> str:
    """A hint for the error of a run with the lab file `lab`; empty when nothing has to be done at the robot.

    `moved` states that motion may have begun: the gripper may be above or in the hole, with a part.
    """
    options = f"--lab {shlex.quote(str(lab))}"
    for words, action in (
        (("FAST_STOP", "_FAULT", "BAD_CHECKSUM"), "acknowledge the gripper's fault with: gelflow robot acknowledge"),
        (("not homed", "not referenced"), "home the gripper with: gelflow robot home"),
        (("holds a part", "part may be held", "a part is held"), "open the gripper with: gelflow robot open"),
    ):
        if any(word in error for word in words):
            return f"{action} {options}"
    return f"raise the gripper with: gelflow robot jog {options} z +10" if moved else ""
