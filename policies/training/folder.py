"""Folders of trainings and evaluations."""

import tempfile
from pathlib import Path

from gelflow.errors import UsageError


def create_folder(folder: Path) -> None:
    """Creates a folder if it does not exist. Raises UsageError when no file can be written into it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror}") from error
