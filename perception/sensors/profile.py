"""Sensor profiles: TOML files with the image of a camera and the printed markers of its gel."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import PeerError, UsageError
from gelflow.gel.gel_file import ElasticGel
from gelflow.perception.frames import ImageDecoder, Reduction, reduce_image
from gelflow.toml_tables import TomlTable, read_toml, suggestion

Image = NDArray[np.uint8]

FORMAT = 1
_FOLDER = Path(__file__).parent
_SMALLEST = 32  # px that a crop leaves


@dataclass(frozen=True)
class PrintedMarkers:
    """The printed grid; 0 where it is detected in the image, or not known."""

    rows: int = 0
    cols: int = 0
    pitch_mm: float = 0.0  # distance of neighbouring markers on the gel at rest

    def __post_init__(self) -> None:
        if self.rows < 0 or self.cols < 0 or (self.rows == 0) != (self.cols == 0):
            raise UsageError(f"rows and cols must both be positive, or both be absent, got {self.rows}, {self.cols}")
        if not 0 <= self.pitch_mm <= 1000:
            raise UsageError(f"pitch_mm must be within 0 to 1000, got {self.pitch_mm:g}")


@dataclass(frozen=True)
class SensorImage:
    """The image of the camera and the part of it that is used."""

    width: int = 0  # of the image as sent [px]; 0: any
    height: int = 0
    reduce: Reduction = 1  # the image is decoded at 1 / `reduce` of its size: 1, 2, 4 or 8
    crop: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # share cut off left, top, right, bottom

    def __post_init__(self) -> None:
        if self.width < 0 or self.height < 0 or (self.width == 0) != (self.height == 0):
            raise UsageError(
                f"width and height must both be positive, or both be absent, got {self.width}, {self.height}"
            )
        if self.reduce not in get_args(Reduction):
            raise UsageError(f"reduce must be 1, 2, 4 or 8, got {self.reduce}")
        left, top, right, bottom = self.crop
        if min(self.crop) < 0 or left + right >= 1 or top + bottom >= 1:
            raise UsageError(
                f"crop must hold shares of at least 0 that leave a part of the image, got {list(self.crop)}"
            )

    @property
    def is_plain(self) -> bool:
        """Whether images are used as they are sent."""
        return self.reduce == 1 and not any(self.crop)


@dataclass(frozen=True)
class SensorProfile:
    """A kind of tactile sensor; see `load_sensor_profile`."""

    format: int
    title: str
    markers: PrintedMarkers = field(default_factory=PrintedMarkers)
    image: SensorImage = field(default_factory=SensorImage)
    gel: ElasticGel | None = None  # a first guess

    def decode(self, data: bytes, decoder: ImageDecoder | None = None) -> Image:
        """The used part of a JPEG or PNG image, B G R, uint8. JPEG data are decoded at the reduced size.

        `decoder` is that of the other images of the source. Raises PeerError when the data are not an image, or the
        image does not have the size of the profile.
        """
        image = (decoder or ImageDecoder())(data, reduce=self.image.reduce)
        return self._cropped(image, *(math.ceil(size / self.image.reduce) for size in self._size))

    def prepare(self, image: Image) -> Image:
        """The used part of a decoded image, reduced by averaging. Raises PeerError as `decode` does."""
        image = reduce_image(image, self.image.reduce)
        return self._cropped(image, *(math.ceil(size / self.image.reduce) for size in self._size))

    def used_positions(self, positions: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
        """Positions in the used part of an image, of positions in the image as sent; (right, down) [px], shape (n, 2).

        `size` is the width and height of the used part [px].
        """
        left, top, right, bottom = self.image.crop
        whole = [
            math.ceil(sent / self.image.reduce) if sent else round(used / share)
            for sent, used, share in zip(self._size, size, (1 - left - right, 1 - top - bottom), strict=True)
        ]
        corner = self.crop_pixels(whole[0], whole[1])[:2]
        return np.asarray((positions + 0.5) / self.image.reduce - 0.5 - corner)

    @property
    def _size(self) -> tuple[int, int]:
        return self.image.width, self.image.height

    def _cropped(self, image: Image, width: int, height: int) -> Image:
        """The part of an image inside the crop; the image must be `width` × `height` px where these are not 0."""
        rows, cols = image.shape[:2]
        if width and (cols, rows) != (width, height):
            scale = f" at 1/{self.image.reduce} of its size" if self.image.reduce > 1 else ""
            raise PeerError(
                f"the profile {self.title!r} is for images of {self.image.width} × {self.image.height} px, this one "
                f"has {cols} × {rows} px{scale}: set the camera to this size, or use --profile generic"
            )
        left, top, right, bottom = self.crop_pixels(cols, rows)
        if right - left < _SMALLEST or bottom - top < _SMALLEST:
            raise PeerError(f"an image of {cols} × {rows} px is too small for the crop of the profile {self.title!r}")
        return np.ascontiguousarray(image[top:bottom, left:right])

    def crop_pixels(self, width: int, height: int) -> tuple[int, int, int, int]:
        """First column and row, and last ones exclusive, of the used part of an image of `width` × `height` px."""
        left, top, right, bottom = self.image.crop
        return round(left * width), round(top * height), width - round(right * width), height - round(bottom * height)


def sensor_profile_names() -> list[str]:
    """Names of the profiles that come with gelflow."""
    return sorted(path.stem.replace("_", "-") for path in _FOLDER.glob("*.toml"))


def load_sensor_profile(name: str) -> SensorProfile:
    """The profile `name` that comes with gelflow, or of a TOML file.

    Raises UsageError if there is none, or its file is wrong.
    """
    path = Path(name)
    if path.suffix != ".toml":
        if name not in sensor_profile_names():
            raise UsageError(f"no sensor profile {name!r}; {suggestion(name, sensor_profile_names())}, or a .toml file")
        path = _FOLDER / f"{name.replace('-', '_')}.toml"
    table = TomlTable(read_toml(path), str(path))
    if (written := table.integer("format")) != FORMAT:
        raise UsageError(f"{path} has format {written}; this gelflow reads format {FORMAT}: update gelflow")
    # A gel has no defaults: it is read apart.
    gel = table.table("gel").as_dataclass(ElasticGel) if "gel" in table.data else None
    rest = TomlTable({name: value for name, value in table.data.items() if name != "gel"}, table.location)
    return replace(rest.as_dataclass(SensorProfile), gel=gel)
