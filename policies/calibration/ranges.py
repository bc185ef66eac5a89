"""Ranges of the randomization from a calibration: those of the quantities that the recordings determine."""

import json
import math
from pathlib import Path
from typing import Any

from gelflow.errors import UsageError
from gelflow.policies.calibration.report import FORMAT
from gelflow.sim.tasks.insertion_randomization import DEFAULT_RANDOMIZATION


def read_ranges(path: Path) -> dict[str, list[float]]:
    """Quantity → [low, high], of the file `report.json` of a calibration.

    Raises UsageError when the file is no such report, is newer, or its recordings determine no quantity.
    """
    try:
        report: Any = json.loads(path.read_text())
        number, found = report["format"], report["randomization"]
        ranges = {str(name): [float(low), float(high)] for name, (low, high) in found.items()}
    except OSError as error:
        raise UsageError(f"cannot read the calibration {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError):
        raise UsageError(f"{path} is not the report.json of gelflow calibrate") from None
    if number != FORMAT:
        raise UsageError(f"{path}: format must be {FORMAT}, got {number!r}")
    if not ranges:
        raise UsageError(f"{path}: the recordings determine no quantity of the randomization; see record_next there")
    for name, (low, high) in ranges.items():
        if name not in list(DEFAULT_RANDOMIZATION) or not (math.isfinite(low) and math.isfinite(high) and low <= high):
            raise UsageError(f"{path}: invalid range of {name}: {low} to {high}")
    return ranges
