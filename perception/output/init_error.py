"""Picture of an image on which the tracker could not start."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from gelflow.errors import PeerError
from gelflow.perception.errors import TrackerInitError


@contextmanager
def picture_of_init_error(beside: Path) -> Iterator[None]:
    """Save the picture of a `TrackerInitError` beside the file `beside`, and name it in the message.

    Raises PeerError in place of the TrackerInitError.
    """
    try:
        yield
    except TrackerInitError as error:
        file = beside.with_name(f"{beside.stem}-refused.png")
        note = f"the picture {file} shows the detected dots"
        if not cv2.imwrite(str(file), error.picture):
            note = f"the picture of the detected dots, {file}, cannot be written"
        raise PeerError(f"{error}; {note}") from None
