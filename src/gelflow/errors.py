"""Exceptions of gelflow, with one common base class.

Wrong input (an argument, a file, a setting) and misbehaviour of a peer (a device, a stream, a recording) are different
classes because they need different actions: correct the input, or inspect the machine. The command line prints any of
them as one line and exits with code 2.
"""


class GelflowError(Exception):
    """Base class of all exceptions that gelflow raises deliberately."""


class UsageError(GelflowError, ValueError):
    """Wrong input: a key, a file, a shape, a range."""


class PeerError(GelflowError):
    """A device, stream or recording violates its protocol."""


class PeerTimeout(PeerError):
    """A peer did not answer within its time limit."""


class PeerRefused(PeerError):
    """A peer rejected a request; the message contains its status."""


class SafetyError(GelflowError):
    """A motion was rejected before anything was sent, or a latched stop forbids motion."""


class SimulationError(GelflowError):
    """The simulator could not compute a step; its state is that before the step."""
