"""Write a scene from scratch, MJCF and TOML, and press its pad on a ball."""

import tempfile
from pathlib import Path

import numpy as np

import gelflow.sim as gs

MODEL = """
<mujoco>
  <worldbody>
    <geom name="ball" type="sphere" size="0.01" pos="0 0 0.01"/>
    <body name="finger" pos="0 0 0.025">
      <joint name="finger_z" type="slide" axis="0 0 1" damping="1"/>
      <geom name="finger" type="box" size="0.008 0.008 0.005" mass="0.05"/>
      <site name="face" pos="0 0 -0.005" xyaxes="1 0 0 0 -1 0"/>
    </body>
  </worldbody>
  <actuator>
    <position name="finger_z" joint="finger_z" kp="500" kv="5"/>
  </actuator>
</mujoco>
"""

SCENE = """
format = 1
model = "press.xml"
step = 2e-3

[points.finger]
geom = "finger"
resolution = [9, 9, 2]
faces = ["-z"]

[contacts.finger_ball]
points = "finger"
against = "ball"
kn = 300.0
kt = 1.0
kd = 10.0
mu = 0.8

[pads.pad]
site = "face"
against = "ball"
rows = 7
cols = 7
pitch = 2e-3
kn = 300.0
kt = 1.0
kd = 10.0
mu = 0.8
"""

with tempfile.TemporaryDirectory() as folder:
    Path(folder, "press.xml").write_text(MODEL)
    Path(folder, "press.toml").write_text(SCENE)
    scene = gs.load_scene(Path(folder, "press.toml"))

sim = gs.Simulator(scene)
sim.step(np.array([[-1e-3]]), steps=250)  # the target is 1 mm below the top of the ball
sim.check()
normal = sim.tactile()[0, :, 2].reshape(7, 7)  # [N]
print("normal force per marker [mN]:")
print(np.round(1e3 * normal, 1))
