"""Domain randomization as a table: every physical quantity of a task has a distribution, a unit and a meaning."""

import dataclasses
import math
import numbers
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim.arguments import check_type, shown
from gelflow.toml_tables import suggestion

Array = NDArray[np.float64]


class Distribution(Protocol):
    """Distribution of one quantity."""

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """`count` independent values."""

    def with_range(self, low: float, high: float) -> "Distribution":
        """The same kind of distribution, between `low` and `high`."""


def _check_numbers(distribution: Distribution) -> None:
    for name, value in vars(distribution).items():
        check_type(name, value, numbers.Real, "a number")


@dataclass(frozen=True)
class Uniform:
    """Uniform between `low` and `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _check_numbers(self)
        if not 0 <= self.high - self.low < math.inf:
            raise UsageError(f"a range must be (low, high) with low ≤ high, got ({self.low}, {self.high})")

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        return rng.uniform(self.low, self.high, count)

    def with_range(self, low: float, high: float) -> "Uniform":
        return Uniform(low, high)


@dataclass(frozen=True)
class LogUniform:
    """Uniform in the logarithm between `low` and `high`."""

    low: float
    high: float

    def __post_init__(self) -> None:
        _check_numbers(self)
        if not 0 <= self.high - self.low < math.inf:
            raise UsageError(f"a range must be (low, high) with low ≤ high, got ({self.low}, {self.high})")
        if not self.low > 0:
            raise UsageError(f"a logarithmic range must be positive, got ({self.low}, {self.high})")

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        return np.exp(rng.uniform(np.log(self.low), np.log(self.high), count))

    def with_range(self, low: float, high: float) -> "LogUniform | Uniform":
        return Uniform(0.0, 0.0) if low == high == 0 else LogUniform(low, high)


@dataclass(frozen=True)
class Normal:
    """Normal with `mean` and standard deviation `std`."""

    mean: float
    std: float

    def __post_init__(self) -> None:
        _check_numbers(self)
        if not 0 <= self.std < math.inf or not math.isfinite(self.mean):
            raise UsageError(f"a normal distribution needs a finite mean and std ≥ 0, got ({self.mean}, {self.std})")

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        return rng.normal(self.mean, self.std, count)

    def with_range(self, low: float, high: float) -> "Normal | Uniform":
        return Normal(low, 0.0) if low == high else Uniform(low, high)


@dataclass(frozen=True)
class Fixed:
    """Always `value`; uses no random number."""

    value: float

    def __post_init__(self) -> None:
        _check_numbers(self)
        if not math.isfinite(self.value):
            raise UsageError(f"a fixed value must be finite, got {self.value}")

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        return np.full(count, float(self.value))

    def with_range(self, low: float, high: float) -> "Fixed | Uniform":
        return Fixed(low) if low == high else Uniform(low, high)


@dataclass(frozen=True)
class Quantity:
    """One row of a randomization table."""

    distribution: Distribution
    unit: str  # "" for a ratio
    meaning: str
    friction: str | None = None  # sampled under this friction law only; None: under both


@dataclass(frozen=True)
class Randomization:
    """A randomization table: name → quantity, sampled in the order of the rows, once per episode.

    `samples` contains lists of equally many values (k,) for some quantities. An episode draws one index and takes the
    value at this index from each list, so that the quantities keep their dependence on each other. The distributions of
    these quantities are not used.
    """

    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    samples: Mapping[str, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_type("quantities", self.quantities, Mapping, "a mapping of names to quantities")
        for name, row in self.quantities.items():
            check_type(f"quantity {name!r}", row, Quantity, "a Quantity")
        object.__setattr__(self, "quantities", MappingProxyType(dict(self.quantities)))
        object.__setattr__(self, "samples", MappingProxyType(self._checked(self.samples)))

    def __reduce__(self) -> tuple[Any, ...]:
        """For copies and pickles, as Gymnasium makes of the arguments of an environment."""
        return Randomization, (dict(self.quantities), dict(self.samples))

    def __iter__(self) -> Iterator[str]:
        return iter(self.quantities)

    def __getitem__(self, name: str) -> Quantity:
        if name not in self.quantities:
            raise UsageError(f"randomization has no quantity {name!r}; {suggestion(name, self.quantities)}")
        return self.quantities[name]

    def sample(self, rng: np.random.Generator, count: int, *, friction: str) -> dict[str, Array]:
        """Values of `count` episodes, name → (count,), of the quantities that the friction law has."""
        size = next((len(values) for values in self.samples.values()), 0)
        chosen = rng.integers(size, size=count) if size else None
        return {
            name: self.samples[name][chosen] if name in self.samples else row.distribution.sample(rng, count)
            for name, row in self.quantities.items()
            if row.friction in (None, friction)
        }

    def replace(self, **changes: "Distribution | float | tuple[float, float]") -> "Randomization":
        """The table with other distributions of some quantities.

        A number fixes the quantity; a pair (low, high) sets the range and keeps the kind of distribution, except that a
        normal one becomes uniform. The other quantities keep their random values, unless a quantity changes to or from
        `Fixed`. Raises UsageError for an unknown quantity or an invalid range.
        """
        quantities = dict(self.quantities)
        samples = {name: values for name, values in self.samples.items() if name not in changes}
        for name, value in changes.items():
            row = self[name]
            try:
                quantities[name] = dataclasses.replace(row, distribution=_distribution(value, row.distribution))
            except UsageError as error:
                raise UsageError(f"randomization: {name}: {error}") from None
        return Randomization(quantities, samples)

    def drawn_from(self, samples: Mapping[str, Sequence[float] | Array]) -> "Randomization":
        """The table with some quantities drawn together from `samples`, quantity → values (k,).

        Raises UsageError for an unknown quantity, values that are not finite, and different numbers of values.
        """
        return Randomization(self.quantities, {**self.samples, **samples})  # type: ignore[dict-item]

    def _checked(self, samples: Mapping[str, Any]) -> dict[str, Array]:
        checked = {}
        for name, values in samples.items():
            self[name]  # raises UsageError
            try:
                checked[name] = np.array(values, dtype=float)
            except (TypeError, ValueError):
                checked[name] = np.zeros(0)
            if checked[name].ndim != 1 or not len(checked[name]) or not np.isfinite(checked[name]).all():
                raise UsageError(f"randomization: {name}: samples must be finite numbers, got {shown(values)}")
        if len(sizes := {len(values) for values in checked.values()}) > 1:
            raise UsageError(f"randomization: all quantities need equally many samples, got {sorted(sizes)}")
        return checked

    def rows(self) -> list[dict[str, Any]]:
        """The table as plain data, for checkpoints and documents."""
        return [
            {
                "quantity": name,
                **self._described(name),
                "unit": row.unit,
                "friction": row.friction,
                "meaning": row.meaning,
            }
            for name, row in self.quantities.items()
        ]

    def _described(self, name: str) -> dict[str, Any]:
        if name in self.samples:
            values = self.samples[name]
            return {"distribution": "Samples", "low": float(values.min()), "high": float(values.max())}
        given = self.quantities[name].distribution
        return {"distribution": type(given).__name__, **vars(given)}


def fixed_values(quantities: Mapping[str, Quantity]) -> dict[str, float]:
    """Values of those quantities that are fixed."""
    found = {name: row.distribution for name, row in quantities.items()}
    return {name: given.value for name, given in found.items() if isinstance(given, Fixed)}


def _distribution(value: Any, present: Distribution) -> Distribution:
    if hasattr(value, "sample"):
        given: Distribution = value
        return given
    try:
        limits = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        limits = np.zeros(0)
    if limits.shape not in ((), (2,)) or not np.isfinite(limits).all():
        raise UsageError(f"expected a number, a pair (low, high) or a distribution, got {value!r}")
    low, high = np.broadcast_to(limits, 2).tolist()
    return present.with_range(low, high)
