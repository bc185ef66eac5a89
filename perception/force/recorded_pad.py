"""The gel and the camera of a pad in the description of a recorded run."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gelflow.errors import PeerError
from gelflow.gel.gel_file import ElasticGel
from gelflow.perception.frames import CameraMount
from gelflow.session.reader import SessionReader
from gelflow.session.records import SENSORS, from_plain


@dataclass(frozen=True)
class RecordedPad:
    """A pad in the lab of a run."""

    mount: CameraMount
    gel: ElasticGel | None  # None: the lab file named none


def recorded_pad(path: str, sensor: str) -> RecordedPad | None:
    """The pad `sensor`, left or right, of a session; None where its description has no pads.

    Raises UsageError when `path` is no session, and when another version wrote the description.
    """
    try:
        with SessionReader(path) as session:
            described: Mapping[str, Any] = session.description()
    except PeerError:  # no description, or damage, which the reader of the images states
        return None
    number, mounts = SENSORS.index(sensor), described.get("mounts") or ()
    if number >= len(mounts):
        return None
    gel = (described.get("gels") or [None] * len(SENSORS))[number]
    return RecordedPad(
        from_plain(CameraMount, mounts[number], what="camera mount of the session"),
        None if gel is None else from_plain(ElasticGel, gel, what="gel of the session"),
    )
