"""The world of the mock robot: physics, gels, cameras, arm and taught pose, by default as the policy was trained.

A TOML file changes any of them, to test the runner in a cell that differs from training. SI units, unless the name of
a key ends in `_mm`, `_px` or `_deg`.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel, load_gel
from gelflow.geometry import Pose, yaw_quaternion
from gelflow.observation import Grid
from gelflow.part import CUBOID
from gelflow.part import Part as TrainedPart
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.lens import Lens
from gelflow.sim.scene.gel import MAX_LAYER_MARKERS
from gelflow.sim.tasks.parts import part_geometry
from gelflow.toml_tables import TomlTable, read_toml

FORMAT = 1
_LARGEST_CLEARANCE = 0.020  # of the hole: its walls must still support a part beside it [m]


def _check(table: object, limits: dict[str, tuple[float, float]]) -> None:
    for name, (low, high) in limits.items():
        value = getattr(table, name)
        if not low <= value <= high:
            raise UsageError(f"{name} must be within {low:g} to {high:g}, got {value}")


@dataclass(frozen=True)
class Friction:
    """Friction coefficients of the part."""

    pads: float = 1.5  # against the gels
    hole: float = 1.5  # against the walls and the rim of the hole
    floor: float = 0.8  # against the floor of the hole

    def __post_init__(self) -> None:
        _check(self, {"pads": (1e-5, 5), "hole": (0, 5), "floor": (0, 5)})


@dataclass(frozen=True)
class Gels:
    """Stiffness of each gel relative to that of the scene or of the file: 5 moves the markers a fifth as far."""

    left: float = 1.0
    right: float = 1.0
    file: str = ""  # gel file of both pads, relative to the world file: an elastic layer; empty: springs of the scene

    def __post_init__(self) -> None:
        _check(self, {"left": (1e-3, 2500), "right": (1e-3, 2500)})

    def layer(self) -> ElasticGel | None:
        """The gel of the file; None without one. Raises UsageError when the file cannot be read."""
        return load_gel(Path(self.file)) if self.file else None


@dataclass(frozen=True)
class Hole:
    """Size and stiffness of the hole."""

    clearance: tuple[float, float] = (4.5e-3, 4.5e-3)  # opening minus part, along x and y [m]
    stiffness: float = 1.0  # of walls, rim and floor, relative to the scene's

    def __post_init__(self) -> None:
        _check(self, {"stiffness": (0.02, 50)})
        if not all(0 < c <= _LARGEST_CLEARANCE for c in self.clearance):
            raise UsageError(f"clearance must be above 0 and a few millimetres, got {self.clearance} m")


@dataclass(frozen=True)
class TaughtError:
    """Error of the taught pose of the hole: the lab file's pose relative to the true one, in the hole frame."""

    x: float = 0.0  # [m]
    y: float = 0.0  # [m]
    z: float = 0.0  # negative: the hole is taught too low [m]
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        _check(self, dict.fromkeys("xyz", (-0.05, 0.05)) | {"yaw_deg": (-45, 45)})

    @property
    def pose(self) -> Pose:
        """The taught hole frame in the true one."""
        return Pose(np.array([self.x, self.y, self.z]), yaw_quaternion(math.radians(self.yaw_deg)))


@dataclass(frozen=True)
class MarkerPrint:
    """Markers printed on both gels, rows from the base to the tip of the finger."""

    rows: int = 18
    cols: int = 14
    pitch_mm: float = 1.4
    center_mm: tuple[float, float] = (2.0, 0.0)  # of the grid on the pad, x towards the fingertip
    jitter_mm: float = 0.0  # standard deviation of a marker's position from the regular grid
    missing: float = 0.0  # fraction of the markers that are not printed

    def __post_init__(self) -> None:
        _check(self, {"rows": (2, 60), "cols": (2, 60), "pitch_mm": (0.3, 10), "jitter_mm": (0, 2), "missing": (0, 1)})

    @property
    def grid(self) -> Grid:
        """The regular grid on the pad."""
        return Grid(self.rows, self.cols, self.pitch_mm, self.center_mm)


@dataclass(frozen=True)
class SensorEffects:
    """Deviations of both sensors from an elastic gel with perfect markers; 0: none."""

    creep: float = 0.0  # part of the deformation that follows the force with a lag
    creep_time: float = 0.1  # time constant of this lag [s]
    crosstalk: float = 0.0  # part of a marker's motion that is the mean of its four nearest neighbours
    gain_spread: float = 0.0  # standard deviation of the logarithm of a marker's gain
    noisy: float = 0.0  # fraction of the markers with the following noise
    noise_mm: float = 0.02  # standard deviation, per image
    drift_mm: float = 0.0  # of all markers of a pad per minute, in a direction of its own

    def __post_init__(self) -> None:
        fractions = dict.fromkeys(("creep", "crosstalk", "noisy"), (0.0, 1.0))
        _check(
            self,
            fractions | {"creep_time": (1e-3, 100), "gain_spread": (0, 1), "noise_mm": (0, 1), "drift_mm": (0, 10)},
        )

    @property
    def ideal(self) -> bool:
        """Whether there are no deviations."""
        return not (self.creep or self.crosstalk or self.gain_spread or self.noisy or self.drift_mm)


@dataclass(frozen=True)
class CameraView:
    """Image of one camera."""

    rate: float = 30.0  # images per second
    pixels_per_mm: float = 15.7  # scale at the image centre
    dot_radius_px: float = 4.4
    contrast: float = 0.62  # of the dots, 0 to 1
    light: float = 125.0  # mean brightness of the gel [grey levels]
    blur_px: float = 1.0  # standard deviation
    noise: float = 1.2  # standard deviation of the sensor noise [grey levels]
    tilt_deg: tuple[float, float] = (0.0, 0.0)  # about the image's right and down axes
    distance_mm: float = 40.0  # of the camera from the gel; a shorter distance increases the effect of a tilt
    barrel: float = 0.0  # relative inward shift of the image corners; negative: pincushion
    calibrated: bool = True  # the lab file has a calibration file for a tilted or distorted image; false: only a scale

    def __post_init__(self) -> None:
        _check(self, {"rate": (1, 200)})
        self.appearance(MarkerPrint())
        _ = self.lens

    def appearance(self, printed: MarkerPrint, *, seed: int = 0) -> GelAppearance:
        """The appearance of a gel with the markers `printed`."""
        return GelAppearance(
            grid=printed.grid,
            pixels_per_mm=self.pixels_per_mm,
            radius=self.dot_radius_px,
            contrast=self.contrast,
            light=self.light,
            blur=self.blur_px,
            noise=self.noise,
            missing=printed.missing,
            seed=seed,
        )

    @property
    def lens(self) -> Lens:
        """Tilt and distortion."""
        return Lens(self.tilt_deg, self.distance_mm, self.barrel)


@dataclass(frozen=True)
class ArmDynamics:
    """Dynamics of the arm."""

    lag: float = 0.010  # time constant of the controller's filter [s]
    stiffness: float = 1e5  # of the tool against a force [N/m]
    yaw_stiffness: float = 500.0  # [N m/rad]

    def __post_init__(self) -> None:
        _check(self, {"lag": (1e-3, 0.5), "stiffness": (100, 1e7), "yaw_stiffness": (1, 1e5)})


@dataclass(frozen=True)
class Part:
    """The part."""

    mass: float = 0.063  # [kg]

    def __post_init__(self) -> None:
        _check(self, {"mass": (1e-3, 5)})


@dataclass(frozen=True)
class World:
    """Everything in which a cell can differ from training. Equal to training by default."""

    friction: Friction = field(default_factory=Friction)
    gels: Gels = field(default_factory=Gels)
    hole: Hole = field(default_factory=Hole)
    taught_error: TaughtError = field(default_factory=TaughtError)
    markers: MarkerPrint = field(default_factory=MarkerPrint)
    sensor: SensorEffects = field(default_factory=SensorEffects)
    left_camera: CameraView = field(default_factory=CameraView)
    right_camera: CameraView = field(default_factory=CameraView)
    arm: ArmDynamics = field(default_factory=ArmDynamics)
    part: Part = field(default_factory=Part)

    @property
    def cameras(self) -> tuple[CameraView, CameraView]:
        """Views of the left and of the right camera."""
        return self.left_camera, self.right_camera

    @property
    def sensor_effects(self) -> SensorEffects:
        """The deviations of the sensors, with the creep of the gel file.

        Raises UsageError when the file cannot be read, and when it and `sensor` both have a creep.
        """
        gel = self.gels.layer()
        if gel is None or not gel.creep:
            return self.sensor
        if self.sensor.creep:
            raise UsageError(f"creep is in [sensor] and in the gel file {self.gels.file}: give one of them")
        return dataclasses.replace(self.sensor, creep=gel.creep, creep_time=gel.creep_time)

    def true_gel(self, finger: int) -> ElasticGel | None:
        """The gel of a pad with its true values, friction included; None for the springs of the scene."""
        gel = self.gels.layer()
        if gel is None:
            return None
        stiffness = (self.gels.left, self.gels.right)[finger]
        effects = self.sensor_effects
        return dataclasses.replace(
            gel,
            youngs_modulus=gel.youngs_modulus * stiffness,
            youngs_modulus_deviation=0.0,
            creep=effects.creep,
            creep_time=effects.creep_time,
            friction=self.friction.pads,
            friction_deviation=0.0,
        )


def training_world(part: TrainedPart) -> World:
    """The world in which policies for `part` are trained."""
    if part == CUBOID:
        return World()
    return World(hole=Hole(clearance=part.clearance), part=Part(mass=part_geometry(part).mass))


def load_world(path: Path, part: TrainedPart = CUBOID) -> World:
    """Read a world from TOML; without a value, hole and mass are those of `part`.

    Raises UsageError on unknown keys and values out of range, naming the known ones, and on a wrong gel file.
    """
    world = world_from_tables(read_toml(path), str(path), part)
    if not world.gels.file:
        return world
    file = str((path.parent / world.gels.file).resolve())
    world = dataclasses.replace(world, gels=dataclasses.replace(world.gels, file=file))
    try:
        _ = world.sensor_effects
        if (count := world.markers.rows * world.markers.cols) > MAX_LAYER_MARKERS:
            raise UsageError(f"a gel file supports at most {MAX_LAYER_MARKERS} markers, got {count}")
    except UsageError as error:
        raise UsageError(f"{path}, gels: {error}") from None
    return world


def world_from_tables(tables: dict[str, Any], location: str, part: TrainedPart = CUBOID) -> World:
    """A world from the tables of a TOML file at `location`; the table `cameras` holds for both cameras."""
    if tables.get("format", FORMAT) != FORMAT:
        raise UsageError(f"{location}: format must be {FORMAT}, got {tables['format']!r}")
    merged = {key: value for key, value in tables.items() if key not in ("format", "cameras")}
    known = [item.name for item in dataclasses.fields(World)]
    TomlTable(tables, location).check_keys([*known, "cameras", "format"])
    both = TomlTable(tables, location).table("cameras").data
    for name in ("left_camera", "right_camera"):
        merged[name] = {**both, **TomlTable(tables, location).table(name).data}
    if part != CUBOID:
        world = training_world(part)
        for name, key, value in (("hole", "clearance", list(part.clearance)), ("part", "mass", world.part.mass)):
            merged[name] = {key: value, **TomlTable(tables, location).table(name).data}
    return TomlTable(merged, location).as_dataclass(World)


def plain_world(world: World) -> dict[str, Any]:
    """The values of `world` that differ from the default, as tables that `world_from_tables` reads."""

    def changed(value: Any, default: Any) -> dict[str, Any]:
        tables = {}
        for item in dataclasses.fields(value):
            mine, theirs = getattr(value, item.name), getattr(default, item.name)
            if mine != theirs:
                tables[item.name] = changed(mine, theirs) if dataclasses.is_dataclass(mine) else _plain(mine)
        return tables

    return {"format": FORMAT, **changed(world, World())}


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
