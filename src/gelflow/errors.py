"""Every error gelflow raises, under one root.

Local misuse (a wrong argument, file or setting of ours) and a peer's misbehaviour (a device, stream or
recording that does not do what it should) are different classes, because they call for different actions:
fix the input, or look at the machine. The command line prints any of them as one line and exits with 2.
"""


class GelflowError(Exception):
    """Root of all errors that gelflow raises on purpose."""


class UsageError(GelflowError, ValueError):
    """Something that the caller gave is wrong: a key, a file, a shape, a range."""


class PeerError(GelflowError):
    """A device, stream or recording did not do what its protocol promises."""


class PeerTimeout(PeerError):
    """A peer did not answer in time."""


class PeerRefused(PeerError):
    """A peer answered, and the answer was no (the message names its status)."""


class SafetyError(GelflowError):
    """A motion was refused before a byte of it was sent, or a latched stop forbids motion."""


class SimulationError(GelflowError):
    """The simulator could not take a step; the state is the last good one."""
