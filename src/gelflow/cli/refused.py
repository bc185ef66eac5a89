"""The picture of a start that was refused, for the commands that track. No command."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from gelflow.errors import PeerError
from gelflow.perception.errors import TrackerInitError


@contextmanager
def picture_of_refusal(beside: Path) -> Iterator[None]:
    """Where a start in here is refused, says why, and saves what was seen beside a file that the command writes."""
    try:
        yield
    except TrackerInitError as refused:
        file = beside.with_name(f"{beside.stem}-refused.png")
        told = f"the picture {file} shows what was seen"
        if not cv2.imwrite(str(file), refused.picture):
            told = f"the picture of what was seen, {file}, can not be written"
        raise PeerError(f"{refused}; {told}") from None
