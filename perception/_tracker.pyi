import numpy as np
from numpy.typing import NDArray

PROFILE_STEPS: int

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
        reach: float,
        rest: NDArray[np.float64],
        seen: NDArray[np.bool_],
        oval: NDArray[np.float64],
        contrast: NDArray[np.float64],
    ) -> None: ...
    def start(
        self, image: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...
    def rest(self) -> NDArray[np.float64]: ...
    def track(
        self, image: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]: ...
