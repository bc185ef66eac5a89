"""The bar of the grasp task: block masses, its rest on the tables, and a load that slides inside it."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.geometry import Pose
from gelflow.sim.arguments import integer
from gelflow.sim.scene import Scene
from gelflow.sim.scene.joint_limits import JointLimit
from gelflow.sim.scene.mjcf.mechanics import BodyDef, JointDef

Array = NDArray[np.float64]

BLOCK = 25e-3  # [m] edge length of a block
SCENE_BLOCKS = 11  # of the bar in the scene file
MIN_BLOCKS, MAX_BLOCKS = 5, 21
_TABLE_INSET = 37.5e-3  # [m] from the end of the bar to the centre of the table below it
_TABLE_HALF_WIDTH = 15e-3  # [m]
_POINT_SPACING = BLOCK / 2  # [m] between the contact points of the bar in the scene file, along the bar
_TIP_MARGIN = 5e-3  # [m] from the largest centre of mass to the last contact point on a table
_LOAD_STOP = 500.0  # [N/m] stiffness of the stops of the load
_LOAD_DAMPING = 0.05  # [N s/m]


@dataclasses.dataclass(frozen=True)
class Bar:
    """A bar of `blocks` cubes in a row along y on two tables; lengths in metres, origin in the middle of the bar."""

    blocks: int

    def __post_init__(self) -> None:
        integer("blocks", self.blocks)
        if not MIN_BLOCKS <= self.blocks <= MAX_BLOCKS:
            raise UsageError(f"blocks must be between {MIN_BLOCKS} and {MAX_BLOCKS}, got {self.blocks}")

    @property
    def half_length(self) -> float:
        """Half of the length [m]."""
        return self.blocks * BLOCK / 2

    @property
    def block_centers(self) -> Array:
        """Centre of each block along the bar [m], (blocks,)."""
        return np.asarray((np.arange(self.blocks) - (self.blocks - 1) / 2) * BLOCK, dtype=np.float64)

    @property
    def max_center_of_mass(self) -> float:
        """Largest distance of the centre of mass from the middle [m], so that the bar does not tip on its tables."""
        spacing = _POINT_SPACING * self.blocks / SCENE_BLOCKS
        last_resting = spacing * np.floor((self.table_y + _TABLE_HALF_WIDTH) / spacing + 1e-9)
        return float(last_resting) - _TIP_MARGIN

    @property
    def table_y(self) -> float:
        """Distance of the centres of the tables from the middle [m]; 100 mm for the published 11 blocks."""
        return self.half_length - _TABLE_INSET

    def block_masses(self, mass: Array, center: Array) -> Array:
        """Masses of the blocks [kg], (n, blocks), with the total `mass` (n,) and the centre of mass `center` (n,) [m].

        A geometric series along the bar, the distribution of largest entropy: all masses are positive.
        """
        y = self.block_centers / BLOCK
        target = center / BLOCK
        slope = np.zeros_like(target)
        for _ in range(60):  # Newton's method with limited steps; the mean is monotone in the slope
            weight = np.exp(slope[:, None] * y - np.abs(slope[:, None]) * y[-1])
            weight /= weight.sum(1, keepdims=True)
            mean = weight @ y
            variance = weight @ y**2 - mean**2
            slope = np.clip(slope + np.clip((target - mean) / variance, -1, 1), -12, 12)
        return np.asarray(mass[:, None] * weight)

    def inertia(self, block_masses: Array) -> tuple[Array, Array, Array]:
        """Centre of mass [m], and moments of inertia about x (and z) and about y [kg m²], (n,) each."""
        total = block_masses.sum(1)
        center = block_masses @ self.block_centers / total
        along = (block_masses * (self.block_centers - center[:, None]) ** 2).sum(1)
        own = total * BLOCK**2 / 6
        return center, along + own, own

    def rest(self, scene: Scene, mass: Array, center: Array) -> tuple[Array, Array]:
        """Static rest on the tables: displacement along z [m] and rotation about x [rad], (n,) each.

        A bar that starts elsewhere moves in the first step; in steps of 10 ms the solver may then take a solution in
        which the bar has passed through a table.
        """
        cloud = next(points for points in scene.points if points.name == "bar")
        stiffness = next(c.params["kn"] for c in scene.contacts if c.points == "bar")
        y = cloud.points[:, 1] * self.blocks / SCENE_BLOCKS
        resting = (cloud.points[:, 2] < 0) & (np.abs(np.abs(y) - self.table_y) <= _TABLE_HALF_WIDTH)
        y, k = y[resting], stiffness * cloud.weights[resting]
        weight = -scene.gravity[2] * mass
        center = np.clip(center, -self.max_center_of_mass, self.max_center_of_mass)
        loaded = np.ones((len(mass), len(y)), dtype=bool)
        for _ in range(10):  # points that would pull are released; the set of loaded points settles in two or three
            kn = k * loaded
            moment0, moment1, moment2 = kn.sum(1), kn @ y, kn @ y**2
            determinant = moment0 * moment2 - moment1**2
            depth = weight * (moment2 - moment1 * center) / determinant
            turn = weight * (moment1 - moment0 * center) / determinant
            loaded = depth[:, None] - turn[:, None] * y > 0
        return -depth, turn


def with_load(scene: Scene) -> Scene:
    """The scene with a body "load" that slides inside the bar along y, on a joint of the same name."""
    bar = scene.body("bar")
    inertia = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) * BLOCK**2 / 6
    load = BodyDef(name="load", parent=bar, pose=Pose(), mass=1.0, com=np.zeros(3), inertia=inertia)
    joint = JointDef(
        name="load",
        body=len(scene.bodies),
        type="slide",
        pos=np.zeros(3),
        axis=np.array([0.0, 1.0, 0.0]),
        q_start=scene.nq,
        v_start=scene.nv,
        damping=_LOAD_DAMPING,
        range=(-1.0, 1.0),
    )
    return dataclasses.replace(
        scene,
        bodies=(*scene.bodies, load),
        joints=(*scene.joints, joint),
        limits=(*scene.limits, JointLimit(_LOAD_STOP)),
        q0=np.append(scene.q0, 0.0),
    )
