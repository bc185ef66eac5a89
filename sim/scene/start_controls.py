"""Controls with which a scene starts when nobody has chosen others."""

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.scene.scene import Scene

Array = NDArray[np.float64]


def start_controls(scene: Scene) -> Array:
    """Controls of the model's keyframe, otherwise `holding_controls`. Shape (nu,)."""
    return holding_controls(scene) if scene.keyframe_controls is None else scene.keyframe_controls.copy()


def holding_controls(scene: Scene) -> Array:
    """Controls that hold position servos at the start of the scene; others are 0. Shape (nu,)."""
    lengths = [a.gear * sum(c * scene.q0[j.q_start] for j, c in scene.driven_joints(a)) for a in scene.actuators]
    servo = [a.kind == "position" for a in scene.actuators]
    return np.where(servo, lengths, 0.0)
