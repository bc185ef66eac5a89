"""Sites that a scene file adds to the bodies of its model."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from gelflow.errors import UsageError
from gelflow.geometry import Pose, columns_quaternion
from gelflow.sim.scene.mjcf.mechanics import Mechanics
from gelflow.toml_tables import TomlTable

_PARALLEL = 1e-6  # smallest sine of the angle between two axes of a site


def add_sites(tables: Mapping[str, TomlTable], mechanics: Mechanics) -> Mechanics:
    """The model with the sites of the tables `sites.NAME`: `body`, `pos` [m], `z_axis` and `x_axis` in its frame.

    Raises UsageError on an unknown body, on a name that the model has already, and on axes that define no frame.
    """
    added = {name: _read_site(name, table, mechanics) for name, table in tables.items()}
    return replace(mechanics, sites=mechanics.sites | added)


def _read_site(name: str, table: TomlTable, mechanics: Mechanics) -> tuple[int, Pose]:
    table.check_keys(("body", "pos", "z_axis", "x_axis"))
    if name in mechanics.sites:
        raise UsageError(f"{table.location}: the model has a site {name!r}; choose another name")
    body, frame = table.lookup(mechanics.frames, table.string("body"), "body")
    z, x = (np.array(table.numbers(key, 3, default)) for key, default in (("z_axis", (0, 0, 1)), ("x_axis", (1, 0, 0))))
    across = np.cross(z, x)
    size = float(np.linalg.norm(z) * np.linalg.norm(x))
    if not np.linalg.norm(across) > _PARALLEL * size:
        raise UsageError(f"{table.location}: z_axis {z.tolist()} and x_axis {x.tolist()} must not be zero or parallel")
    z, y = z / np.linalg.norm(z), across / np.linalg.norm(across)
    quaternion = np.array(columns_quaternion((tuple(np.cross(y, z)), tuple(y), tuple(z))))
    return body, frame @ Pose(np.array(table.numbers("pos", 3, (0, 0, 0))), quaternion)
