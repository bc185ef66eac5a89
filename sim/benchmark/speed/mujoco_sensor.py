"""The ball rolling run in MuJoCo with its tactile sensor, for comparison.

Bodies, joints and forces are the same, with a taxel at each marker. MuJoCo's contact is rigid (as far as the step
allows) and not differentiable, and a taxel gives depth and two sliding speeds instead of a force. This is the only
module in which MuJoCo takes steps.
"""

from typing import Any

import mujoco
import numpy as np

from gelflow.measurement.timing import Workload
from gelflow.sim.benchmark.speed.timed_run import TimedRun
from gelflow.sim.scene import Scene

# With MuJoCo's default contact the heavy pad sinks 16 mm into the light ball; with this one 0.5 mm, as in gelflow.
STIFF = {"solref": (0.01, 1.0), "solimp": (0.99, 0.9999, 0.001, 0.5, 2.0)}


class MujocoRolling:
    """The rolling run in MuJoCo, for a scene `rolling` with a square marker grid.

    `readings` (3, markers) is a view of the sensor data of the last evaluation: depth and two sliding speeds.
    """

    def __init__(self, scene: Scene, run: TimedRun) -> None:
        taxels = scene.pads[0].positions
        self.model = _model(scene, taxels)
        self.data = mujoco.MjData(self.model)
        self.readings = self.data.sensordata.reshape(3, len(taxels))
        self._run = run
        self._off = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)

    def start(self) -> None:
        """Reset to the start of the run."""
        mujoco.mj_resetData(self.model, self.data)
        self.model.opt.disableflags |= self._off

    def execute(self) -> None:
        """Execute the run; the sensor is enabled only where it is evaluated."""
        model, data, off = self.model, self.data, self._off
        for steps, u, read in self._run.blocks:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, steps)
            if read:
                model.opt.disableflags &= ~off
                mujoco.mj_sensorVel(model, data)
                model.opt.disableflags |= off

    def workload(self) -> Workload:
        """The run as a workload; a unit is a step."""
        return Workload(self.execute, self._run.steps, self.start)


def _model(scene: Scene, taxels: Any) -> Any:
    """The scene's MJCF model with a tactile sensor; its taxels are the vertices of a hidden mesh."""
    spec = mujoco.MjSpec.from_file(str(scene.path.with_name("rolling.xml")))
    spec.option.timestep = scene.step
    for geom in spec.geoms:
        geom.solref[:], geom.solimp[: len(STIFF["solimp"])] = STIFF["solref"], STIFF["solimp"]
    side = round(len(taxels) ** 0.5)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    below, beside = corner + side, corner + 1
    faces = np.concatenate([np.stack([corner, below, beside], axis=1), np.stack([beside, below, below + 1], axis=1)])
    spec.add_mesh(
        name="taxels",
        uservert=taxels.ravel(),
        userface=faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    spec.add_sensor(
        name="taxels",
        type=mujoco.mjtSensor.mjSENS_TACTILE,
        objtype=mujoco.mjtObj.mjOBJ_MESH,
        objname="taxels",
        reftype=mujoco.mjtObj.mjOBJ_GEOM,
        refname="pad",
    )
    model = spec.compile()
    # The compiler rotates the mesh to its principal axes; the sensor expects the vertices in the frame of the pad.
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    model.mesh_vert[:] = taxels
    model.mesh_normal[:] = model.mesh_normal @ turn.reshape(3, 3).T
    return model
