"""Folders of trainings, evaluations and sweeps, and locks of their files between processes."""

import fcntl
import tempfile
from pathlib import Path
from typing import IO, Any

from gelflow.errors import UsageError


def create_folder(folder: Path) -> None:
    """Creates a folder if it does not exist. Raises UsageError when no file can be written into it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror}") from error


def try_lock(file: IO[Any]) -> bool:
    """Lock an open file until it is closed; False where another process has the lock.

    On a file system without locks the result is True.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return True
