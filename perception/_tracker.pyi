import numpy as np
from numpy.typing import NDArray

PROFILE_STEPS: int
MASK_CELLS: int
MASK_REACH: float
LARGEST_REFINEMENT: float

class StartResult:
    @property
    def position(self) -> NDArray[np.float64]: ...
    @property
    def contrast(self) -> NDArray[np.float64]: ...
    @property
    def quality(self) -> NDArray[np.float64]: ...

class TrackResult:
    @property
    def position(self) -> NDArray[np.float64]: ...
    @property
    def displacement(self) -> NDArray[np.float64]: ...
    @property
    def valid(self) -> NDArray[np.bool_]: ...
    @property
    def inferred(self) -> NDArray[np.bool_]: ...
    @property
    def quality(self) -> NDArray[np.float64]: ...

class Tracker:
    def __init__(
        self,
        *,
        width: int,
        height: int,
        channel: int,
        bright: bool,
        rows: int,
        cols: int,
        spacing: float,
        radius: float,
        noise: float,
        profile: NDArray[np.float32],
        profile_reach: float,
        rest: NDArray[np.float64],
        visible: NDArray[np.bool_],
        shape: NDArray[np.float64],
        contrast: NDArray[np.float64],
        tolerated: NDArray[np.float64],
        mask_of: NDArray[np.intp],
        masks: NDArray[np.float32],
    ) -> None: ...
    def start(self, image: NDArray[np.uint8]) -> StartResult: ...
    def rest(self) -> NDArray[np.float64]: ...
    def track(self, image: NDArray[np.uint8]) -> TrackResult: ...
    def refine(
        self, image: NDArray[np.uint8], position: NDArray[np.float64], wanted: NDArray[np.bool_]
    ) -> TrackResult: ...
