"""Simulate many environments at once, each with its own physical parameters."""

import numpy as np

import gelflow.sim as gs

N = 64
rng = np.random.default_rng(0)
scene = gs.load_scene("pushing", preset="fast")
sim = gs.Simulator(scene, num_envs=N)
sim.param("box_ground.mu")[:] = rng.uniform(0.3, 1.0, N)  # a view of shape (N,)
sim.param("box.mass")[:] *= rng.uniform(0.5, 2.0, N)

u = np.zeros((N, scene.nu))
u[:, scene.u("gripper_x")] = 1.0
sim.step(u, steps=40)
sim.check()
moved = sim.q[:, scene.q("box_x")][:, 0] - scene.q0[scene.q("box_x")][0]
friction, mass = sim.param("box_ground.mu"), sim.param("box.mass")
for i in np.argsort(moved)[[0, N // 2, -1]]:
    print(f"mu {friction[i]:.2f}, mass {1e3 * mass[i]:5.1f} g: the box moved {1e3 * moved[i]:5.1f} mm")
