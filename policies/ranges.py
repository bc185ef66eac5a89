"""Ranges of settings: a dataclass states one for each field, and `check_settings` compares them."""

import math
import numbers
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gelflow.errors import UsageError


@dataclass(frozen=True)
class Range:
    """Finite numbers that a setting may have."""

    text: str  # in messages
    has: Callable[[Any], bool]  # for a finite number
    whole: bool = False

    def __contains__(self, value: Any) -> bool:
        kind: type = numbers.Integral if self.whole else numbers.Real
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        return is_number and bool(abs(value) < math.inf and self.has(value))


COUNT = Range("a whole number of at least 1", lambda value: value >= 1, whole=True)
COUNT_FROM_0 = Range("a whole number of at least 0", lambda value: value >= 0, whole=True)
POSITIVE = Range("a finite number above 0", lambda value: value > 0)
NOT_NEGATIVE = Range("a finite number of at least 0", lambda value: value >= 0)
SHARE = Range("a number from 0 to 1", lambda value: 0 <= value <= 1)
SHARE_BELOW_1 = Range("a number of at least 0 and below 1", lambda value: 0 <= value < 1)


def check_settings(settings: object, **ranges: Range | tuple[Range, int]) -> None:
    """Raises UsageError for the first field of `settings` outside its range.

    A range with a number n is that of a tuple with n members.
    """
    for name, wanted in ranges.items():
        value = getattr(settings, name)
        if isinstance(wanted, Range):
            valid, text = value in wanted, wanted.text
        else:
            of_member, count = wanted
            valid = isinstance(value, tuple | list) and len(value) == count and all(one in of_member for one in value)
            text = f"{count} values, each {of_member.text}"
        if not valid:
            raise UsageError(f"{type(settings).__name__}: {name} must be {text}, got {value!r}")
