import numpy as np
from numpy.typing import NDArray

SMALLEST_LOAD: float
REMAINDER: float
REMAINDER_FLOOR: float

class NormalEquations:
    def __init__(
        self, *, gram: NDArray[np.float64], projected: NDArray[np.float64], square: float, weight: float
    ) -> None: ...

class ContactFit:
    @property
    def ratio(self) -> NDArray[np.float64]: ...
    @property
    def twist(self) -> float: ...
    @property
    def centre(self) -> NDArray[np.float64]: ...
    @property
    def normal(self) -> NDArray[np.float64]: ...
    @property
    def remainder(self) -> NDArray[np.float64]: ...
    @property
    def cost(self) -> float: ...
    @property
    def rigid_covariance(self) -> NDArray[np.float64]: ...
    @property
    def wanted(self) -> NDArray[np.bool_]: ...
    def shear(self, position: NDArray[np.float64]) -> NDArray[np.float64]: ...

class ContactFitter:
    def __init__(
        self,
        *,
        position: NDArray[np.float64],
        correlation: NDArray[np.float64],
        smoothing: NDArray[np.float64],
        roughness: NDArray[np.float64],
    ) -> None: ...
    def first(
        self,
        image: NormalEquations,
        *,
        ratios: NDArray[np.float64],
        scales: NDArray[np.float64],
        deviation: float,
        centre: NDArray[np.float64],
    ) -> ContactFit: ...
    def step(self, image: NormalEquations, last: ContactFit) -> ContactFit: ...
    def follow(self, image: NormalEquations, last: ContactFit) -> ContactFit: ...

def solve_nonnegative(
    hessian: NDArray[np.float64], linear: NDArray[np.float64], start: NDArray[np.bool_]
) -> NDArray[np.float64]: ...
