"""Gel files: the elastic layer of a tactile sensor, as TOML."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path

from gelflow.errors import UsageError
from gelflow.toml_tables import TomlTable, read_toml, toml_text

FORMAT = 1


@dataclass(frozen=True)
class ElasticGel:
    """An isotropic elastic layer on a rigid back."""

    youngs_modulus: float  # [Pa]
    poisson_ratio: float
    thickness: float  # [m]
    youngs_modulus_deviation: float = 0.0  # standard deviation, relative to the modulus
    creep: float = 0.0  # part of the deformation that follows the force with a lag, see `creep`
    creep_time: float = 0.1  # time constant of this lag [s]
    friction: float = 0.0  # coefficient between gel and objects; 0: not known
    friction_deviation: float = 0.0  # standard deviation, relative to the coefficient

    def __post_init__(self) -> None:
        if not 0 < self.youngs_modulus < math.inf:
            raise UsageError(f"youngs_modulus must be above 0 Pa, got {self.youngs_modulus:g}")
        if not -1 < self.poisson_ratio <= 0.5:
            raise UsageError(f"poisson_ratio must be above -1 and at most 0.5, got {self.poisson_ratio:g}")
        if not 0 < self.thickness < 1:
            raise UsageError(f"thickness is in metres, above 0 and below 1, got {self.thickness:g}")
        if not 0 <= self.youngs_modulus_deviation < 1:
            raise UsageError(
                "youngs_modulus_deviation is relative to the modulus, at least 0 and below 1, got "
                f"{self.youngs_modulus_deviation:g}"
            )
        if not 0 <= self.friction < math.inf or not 0 <= self.friction_deviation < 1:
            raise UsageError(
                "friction must be at least 0 (0: not known), and friction_deviation at least 0 and below 1, got "
                f"{self.friction:g} and {self.friction_deviation:g}"
            )
        if not 0 <= self.creep < 1 or not 0 < self.creep_time < math.inf:
            raise UsageError(
                f"creep must be at least 0 and below 1, and creep_time above 0 s, got {self.creep:g} and "
                f"{self.creep_time:g}"
            )


def save_gel(gel: ElasticGel, path: str | Path) -> None:
    """Write a new gel file. Raises UsageError if it exists or cannot be written."""
    try:
        with Path(path).open("x", encoding="utf-8") as file:
            file.write(toml_text({"format": FORMAT, "gel": asdict(gel)}))
    except OSError as error:
        raise UsageError(f"cannot create {path}: {error.strerror}") from None


def load_gel(path: str | Path) -> ElasticGel:
    """The gel of a TOML file. Raises UsageError if the file is missing or wrong."""
    table = TomlTable(read_toml(Path(path)), str(path))
    table.check_keys(("format", "gel"))
    if (written := table.integer("format")) != FORMAT:
        raise UsageError(f"{path} has format {written}; this gelflow reads format {FORMAT}: update gelflow")
    return table.table("gel").as_dataclass(ElasticGel)
