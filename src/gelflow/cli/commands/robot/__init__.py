"""`gelflow robot`: manual actions after a stop."""

from gelflow.cli.commands.robot.actions import configure as configure
from gelflow.cli.commands.robot.actions import run as run
