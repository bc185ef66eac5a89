"""CSV files that are written row by row."""

import contextlib
import csv
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from gelflow.errors import PeerError, UsageError


class CsvFile:
    """A new CSV file with a header, in UTF-8; characters of file names that are not UTF-8 become escape sequences.

    Raises UsageError when the file cannot be created, and PeerError when it cannot be written, as on a full disk.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._path = path
        try:
            self._file = path.open("x", encoding="utf-8", errors="backslashreplace", newline="")
        except OSError as error:
            raise UsageError(f"cannot create {path}: {error.strerror}") from None
        self._writer = csv.writer(self._file)
        self.write([columns])

    def write(self, rows: Iterable[Sequence[object]]) -> None:
        """Write rows to the file at once, so that those of a killed run are readable."""
        with self._named_errors():
            self._writer.writerows(rows)
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        with self._named_errors():
            self._file.close()

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.close()  # also drops the rows that could not be written
            raise PeerError(f"cannot write {self._path}: {error.strerror}; rows are missing at its end") from None
