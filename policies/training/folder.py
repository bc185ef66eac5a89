"""Folders of trainings and evaluations."""

from pathlib import Path

from gelflow.errors import UsageError


def create_folder(folder: Path) -> None:
    """Creates a folder if it does not exist. Raises UsageError when that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write into {folder}: {error.strerror}") from error
