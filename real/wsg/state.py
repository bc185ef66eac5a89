"""Assembles the five state values of a WSG-50, which arrive separately, into one measured state."""

from gelflow.errors import PeerError
from gelflow.protocols import GripperState
from gelflow.real.wsg.codec import MM, Reply
from gelflow.real.wsg.constants import STATE_COMMANDS, Command, GraspState, SystemFlag

# Flags that forbid motion until an operator acknowledges them.
FAULTS = (
    SystemFlag.FAST_STOP,
    SystemFlag.TEMP_FAULT,
    SystemFlag.POWER_FAULT,
    SystemFlag.CURRENT_FAULT,
    SystemFlag.FINGER_FAULT,
)
BAD_CHECKSUM = "BAD_CHECKSUM"


class StateAssembler:
    """Collects updates. Not thread-safe: the owner holds a lock."""

    def __init__(self) -> None:
        self._values: dict[Command, tuple[float, float]] = {}
        self._fresh: set[Command] = set()

    def update(self, reply: Reply, stamp: float) -> bool:
        """Store an update received at `stamp` [s]; True when every value is new since the last True.

        Raises PeerError when the grasp state is unknown.
        """
        (value,) = reply.values()
        if reply.command == Command.GRASP_STATE and value not in list(GraspState):
            raise PeerError(f"the gripper sent grasp state {value}, expected 0 to 7: is it a WSG-50?")
        self._values[reply.command] = (value, stamp)
        self._fresh.add(reply.command)
        if len(self._fresh) < len(STATE_COMMANDS):
            return False
        self._fresh.clear()
        return True

    @property
    def complete(self) -> bool:
        """Whether every value has arrived at least once."""
        return len(self._values) == len(STATE_COMMANDS)

    @property
    def oldest(self) -> float:
        """Stamp of the oldest value [s]; requires `complete`."""
        return min(stamp for _, stamp in self._values.values())

    @property
    def flags(self) -> SystemFlag:
        """The flags of the system state; requires `complete`."""
        return SystemFlag(int(self._values[Command.SYSTEM_STATE][0]))

    def state(self, *, corrupt: bool) -> GripperState:
        """The measured state, stamped with its oldest value; requires `complete`. `corrupt` adds BAD_CHECKSUM."""
        value = {command: entry[0] for command, entry in self._values.items()}
        flags = self.flags
        faults = [str(flag.name) for flag in FAULTS if flag in flags] + [BAD_CHECKSUM] * corrupt
        return GripperState(
            width=value[Command.WIDTH] / MM,
            speed=value[Command.SPEED] / MM,
            force=value[Command.FORCE],
            referenced=SystemFlag.REFERENCED in flags,
            grasp=GraspState(int(value[Command.GRASP_STATE])).label,
            fault=", ".join(faults),
            stamp=self.oldest,
        )
