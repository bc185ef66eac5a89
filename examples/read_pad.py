"""Step a scene and read the markers of its tactile pad."""

import numpy as np

import gelflow.sim as gs

scene = gs.load_scene("pushing")  # a finger with a pad pushes a box on the ground
sim = gs.Simulator(scene)

u = np.zeros((1, scene.nu))  # one row of controls per environment
u[:, scene.u("gripper_x")] = 1.0  # [N]
for _ in range(8):
    sim.step(u, steps=5)
    force = sim.tactile()[0, sim.marker_slice("pad")]  # (markers, 3): shear x, shear y, normal [N]
    box = sim.q[0, scene.q("box_x")][0]
    print(f"box at {1e3 * box:6.2f} mm, normal force {force[:, 2].sum():6.3f} N")
sim.check()  # raises SimulationError if an environment failed
