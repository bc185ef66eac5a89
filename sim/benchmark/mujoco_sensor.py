"""The ball rolling run in MuJoCo with its own tactile sensor: what another fast simulator takes for about the same.

The same bodies, joints and forces, and a taxel where each marker is. MuJoCo's contact is rigid (as rigid as the step
allows), nothing is differentiable, and a taxel gives its depth in the other body and two sliding speeds instead of a
force. It is the one place where MuJoCo takes steps.
"""

from typing import Any

import mujoco
import numpy as np

from gelflow.measurement.timing import Workload
from gelflow.sim.benchmark.runs import TimedRun
from gelflow.sim.scene import Scene

# With MuJoCo's usual contact the heavy pad sinks 16 mm into the light ball; so it is half a millimetre, as with ours.
STIFF = {"solref": (0.01, 1.0), "solimp": (0.99, 0.9999, 0.001, 0.5, 2.0)}


class MujocoRolling:
    """The run, on a scene `rolling` with a square grid of markers.

    `readings` (3, markers), MuJoCo's own memory, are what the taxels gave at the last reading.
    """

    def __init__(self, scene: Scene, run: TimedRun) -> None:
        taxels = scene.pads[0].positions
        self.model = _model(scene, taxels)
        self.data = mujoco.MjData(self.model)
        self.readings = self.data.sensordata.reshape(3, len(taxels))
        self._run = run
        self._off = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)

    def place(self) -> None:
        """Put everything at the start."""
        mujoco.mj_resetData(self.model, self.data)
        self.model.opt.disableflags |= self._off

    def go(self) -> None:
        """The run; sensors are off except where they are read."""
        model, data, off = self.model, self.data, self._off
        for steps, u, read in self._run.blocks:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, steps)
            if read:
                model.opt.disableflags &= ~off
                mujoco.mj_sensorVel(model, data)
                model.opt.disableflags |= off

    def work(self) -> Workload:
        """To time it."""
        return Workload(self.go, self._run.steps, self.place)


def _model(scene: Scene, taxels: Any) -> Any:
    """The scene's own model file with a tactile sensor: its taxels are the corners of a mesh that is not drawn."""
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
    # The compiler moved the mesh into its own principal axes, but the sensor takes it to be in those of the pad.
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    model.mesh_vert[:] = taxels
    model.mesh_normal[:] = model.mesh_normal @ turn.reshape(3, 3).T
    return model
