"""Readings of the pads at the end of descents as a function of whitened parameters, with exact derivatives."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gelflow.observation import Unit
from gelflow.policies.calibration.model.fidelity import EXACT, Fidelity
from gelflow.policies.calibration.model.pad_model import PadModel
from gelflow.policies.calibration.model.parameters import Parameter, parameters
from gelflow.policies.calibration.model.shear_model import QUANTITIES, Descents, ShearModel
from gelflow.policies.calibration.recordings import Recordings
from gelflow.sim.displacement import marker_displacement
from gelflow.sim.scene import Scene

Array = NDArray[np.float64]


class ReadingModel:
    """`ShearModel`, then `PadModel`, with the parameters that are fitted to recordings.

    Parameters
    ----------
    recordings: give task, grasp, unit, printed markers, settling time and the spread of start heights; they may have
        no attempt
    threads: of the simulator
    fidelity: see `ShearModel`
    """

    def __init__(self, recordings: Recordings, *, threads: int | None = None, fidelity: Fidelity = EXACT) -> None:
        self.fitted: tuple[Parameter, ...] = parameters(recordings)
        self.forces = ShearModel(recordings.task, settle=recordings.settle, threads=threads, fidelity=fidelity)
        scene = self.forces.scene
        self.pads = PadModel(scene.grids, [pad.positions for pad in scene.pads], printed=recordings.printed)
        self.height_spread = recordings.height_spread
        # Unit of the recordings per newton of a reading.
        self.scale = unit_per_newton(recordings.unit, scene)

    def values(self, point: Array) -> dict[str, Array]:
        """Values of the parameters from points (…, at least the parameters)."""
        return {p.name: p.value(point[..., i]) for i, p in enumerate(self.fitted)}

    def read(self, values: Mapping[str, Array], descents: Descents) -> tuple[Array, NDArray[np.bool_]]:
        """Readings (n, markers, 2) [N] of n descents, and whether they could be simulated; values have shape (n,)."""
        shear, ok = self.forces.shear({name: values[name] for name in QUANTITIES}, descents)
        return self.pads.read(shear, values), ok

    def slopes(self, point: Array, descents: Descents) -> tuple[Array, list[Array]]:
        """Readings (n, markers, 2) [N], and their derivatives by each whitened parameter, then by the start height.

        The start height is in standard deviations. Raises SimulationError when a step fails.
        """
        values = {name: float(value) for name, value in self.values(point).items()}
        directions = [*QUANTITIES, "z"]
        shear, slopes = self.forces.derivatives({q: values[q] for q in QUANTITIES}, descents, directions)
        one = {name: np.asarray(value) for name, value in values.items()}
        of_pads = self.pad_slopes(point, shear)
        changes = []
        for i, parameter in enumerate(self.fitted):
            if i in of_pads:
                changes.append(of_pads[i])
                continue
            slope = slopes[:, directions.index(parameter.name)]
            changes.append(parameter.slope(float(point[i])) * self.pads.read(slope, one))
        changes.append(self.height_spread * self.pads.read(slopes[:, -1], one))
        return self.pads.read(shear, one), changes

    def pad_slopes(self, point: Array, shear: Array) -> dict[int, Array]:
        """Index of each parameter of the pads → derivative of the readings of `shear` (…, markers, 2) by it."""
        values = {name: float(value) for name, value in self.values(point).items()}
        slopes = self.pads.derivatives(shear, values)
        found = {}
        for i, parameter in enumerate(self.fitted):
            if parameter.name in slopes:
                found[i] = parameter.slope(float(point[i])) * slopes[parameter.name]
        return found


def unit_per_newton(unit: Unit, scene: Scene) -> float:
    """Markers' vectors in `unit` per force of the scene's gel [1/N]."""
    return 1.0 if unit == "N" else displacement_scale(scene)


def displacement_scale(scene: Scene) -> float:
    """Displacement of a marker per force of the scene's gel [mm/N]."""
    forces = np.zeros((1, scene.num_markers, 3))
    forces[0, 0, 0] = 1.0
    return float(1e3 * marker_displacement(scene, forces, np.float64)[0, 0, 0])
