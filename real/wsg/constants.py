"""Constants of the WSG-50's binary protocol: commands, statuses, states and flags."""

from enum import IntEnum, IntFlag


class Command(IntEnum):
    """Commands by their id on the wire."""

    LOOP = 0x06
    DISCONNECT = 0x07
    HOME = 0x20
    PRE_POSITION = 0x21
    STOP = 0x22
    FAST_STOP = 0x23
    ACKNOWLEDGE = 0x24
    GRASP = 0x25
    RELEASE = 0x26
    SET_ACCELERATION = 0x30
    GET_ACCELERATION = 0x31
    SET_FORCE_LIMIT = 0x32
    GET_FORCE_LIMIT = 0x33
    SET_SOFT_LIMITS = 0x34
    GET_SOFT_LIMITS = 0x35
    CLEAR_SOFT_LIMITS = 0x36
    TARE_FORCE = 0x38
    SYSTEM_STATE = 0x40
    GRASP_STATE = 0x41
    WIDTH = 0x43
    SPEED = 0x44
    FORCE = 0x45
    TEMPERATURE = 0x46
    DEVICE_INFO = 0x50
    LIMITS = 0x53


class Status(IntEnum):
    """Status code at the start of every reply."""

    SUCCESS = 0
    NOT_AVAILABLE = 1
    NO_SENSOR = 2
    NOT_INITIALIZED = 3
    ALREADY_RUNNING = 4
    FEATURE_NOT_SUPPORTED = 5
    INCONSISTENT_DATA = 6
    TIMEOUT = 7
    READ_ERROR = 8
    WRITE_ERROR = 9
    INSUFFICIENT_RESOURCES = 10
    CHECKSUM_ERROR = 11
    NO_PARAM_EXPECTED = 12
    NOT_ENOUGH_PARAMS = 13
    CMD_UNKNOWN = 14
    CMD_FORMAT_ERROR = 15
    ACCESS_DENIED = 16
    ALREADY_OPEN = 17
    CMD_FAILED = 18
    CMD_ABORTED = 19
    INVALID_HANDLE = 20
    NOT_FOUND = 21
    NOT_OPEN = 22
    IO_ERROR = 23
    INVALID_PARAMETER = 24
    INDEX_OUT_OF_BOUNDS = 25
    CMD_PENDING = 26
    OVERRUN = 27
    RANGE_ERROR = 28
    AXIS_BLOCKED = 29
    FILE_EXISTS = 30


class GraspState(IntEnum):
    """State of the grasping control."""

    IDLE = 0
    GRASPING = 1
    NO_PART = 2
    PART_LOST = 3
    HOLDING = 4
    RELEASING = 5
    POSITIONING = 6
    ERROR = 7

    @property
    def label(self) -> str:
        """The name in `gelflow.protocols.GripperState.grasp`."""
        return self.name.lower().replace("_", " ")


class SystemFlag(IntFlag):
    """Bits of the system state."""

    REFERENCED = 1 << 0
    MOVING = 1 << 1
    BLOCKED_MINUS = 1 << 2
    BLOCKED_PLUS = 1 << 3
    SOFT_LIMIT_MINUS = 1 << 4
    SOFT_LIMIT_PLUS = 1 << 5
    AXIS_STOPPED = 1 << 6
    TARGET_REACHED = 1 << 7
    OVERDRIVE = 1 << 8
    FORCE_CONTROL = 1 << 9
    FAST_STOP = 1 << 12
    TEMP_WARNING = 1 << 13
    TEMP_FAULT = 1 << 14
    POWER_FAULT = 1 << 15
    CURRENT_FAULT = 1 << 16
    FINGER_FAULT = 1 << 17
    CMD_FAILURE = 1 << 18
    SCRIPT_RUNNING = 1 << 19
    SCRIPT_FAILURE = 1 << 20


class UpdateMode(IntEnum):
    """When a state command answers: now, every period, or when the value changes."""

    ONCE = 0
    PERIODIC = 1
    ON_CHANGE = 3


HOME_OUTWARDS = 1
HOME_INWARDS = 2
SHORTEST_PERIOD, LONGEST_PERIOD = 0.010, 9.999  # of updates [s]

STATE_COMMANDS = (Command.SYSTEM_STATE, Command.GRASP_STATE, Command.WIDTH, Command.SPEED, Command.FORCE)
# Results of a motion that has started; any other status refuses one.
RESULTS = (Status.SUCCESS, Status.TIMEOUT, Status.CMD_FAILED, Status.CMD_ABORTED, Status.AXIS_BLOCKED)
_MEANINGS = {
    Status.CMD_FAILED: "no part was between the fingers",
    Status.AXIS_BLOCKED: "the fingers were blocked before their target",
    Status.ACCESS_DENIED: "motion is locked by FAST STOP or by another client",
    Status.NOT_INITIALIZED: "home it first",
    Status.ALREADY_RUNNING: "it is moving or holds a part",
    Status.CMD_ABORTED: "it was stopped",
    Status.RANGE_ERROR: "outside the hardware limits or the soft limits",
}
MOTIONS = (Command.HOME, Command.PRE_POSITION, Command.GRASP, Command.RELEASE)


def meaning(status: Status) -> str:
    """Explanation of the status of a refused or failed motion, for errors."""
    return _MEANINGS.get(status, "see the device's manual")
