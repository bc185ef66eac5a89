"""Joint limits: spring-damper forces beyond the range of a joint."""

from collections.abc import Mapping
from dataclasses import dataclass

from gelflow.errors import UsageError
from gelflow.sim.scene.mjcf.mechanics import Mechanics
from gelflow.toml_tables import TomlTable, suggestion


@dataclass(frozen=True)
class JointLimit:
    """Stiffness and damping of a joint beyond its range."""

    stiffness: float = 0.0  # [N/m] or [N m/rad]
    damping: float = 0.0  # [N s/m] or [N m s/rad]


def read_limits(tables: Mapping[str, TomlTable], mechanics: Mechanics, location: str) -> tuple[JointLimit, ...]:
    """The limits of all joints, in their order; `tables` maps joint names to the tables `joints.NAME`.

    A joint with a range and no `limit_stiffness` has the default of `mjcf.actuators.default_limit`. Raises UsageError
    on an unknown joint, and on a limit of a joint without a range.
    """
    names = [joint.name for joint in mechanics.joints]
    for name, table in tables.items():
        if name not in names:
            raise UsageError(f"{table.location}: the model has no joint {name!r}; {suggestion(name, names)}")
        table.check_keys(("limit_stiffness", "limit_damping"))
    limits = []
    for joint in mechanics.joints:
        table = tables.get(joint.name, TomlTable({}, location))
        if table.data and joint.range is None:
            raise UsageError(f"{location}: joint {joint.name!r} has no range in the model; a limit needs one")
        stiffness, damping = joint.default_limit or (0.0, 0.0)
        if "limit_stiffness" in table.data:
            stiffness, damping = table.number("limit_stiffness", minimum=0), 0.0
        limits.append(JointLimit(stiffness, table.number("limit_damping", damping, minimum=0)))
    return tuple(limits)
