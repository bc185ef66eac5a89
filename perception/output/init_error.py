"""Picture of an image on which the tracker could not start."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gelflow.errors import PeerError
from gelflow.perception.errors import TrackerInitError
from gelflow.perception.overlay import write_picture


@contextmanager
def picture_of_init_error(beside: Path) -> Iterator[None]:
    """Save the picture of a `TrackerInitError` in a new file beside `beside`, and name it in the message.

    Raises PeerError in place of the TrackerInitError.
    """
    try:
        yield
    except TrackerInitError as error:
        file = _new_file(beside)
        note = f"the picture {file} shows the detected dots"
        try:
            write_picture(file, error.picture)
        except OSError:
            note = f"the picture of the detected dots, {file}, cannot be written"
        raise PeerError(f"{error}; {note}") from None


def _new_file(beside: Path) -> Path:
    """`NAME-refused.png` for `NAME` of `beside`, or the first of `NAME-refused-2.png`, ... that does not exist."""
    names = itertools.chain([""], (f"-{number}" for number in itertools.count(2)))
    files = (beside.with_name(f"{beside.stem}-refused{name}.png") for name in names)
    return next(file for file in files if not file.exists())
