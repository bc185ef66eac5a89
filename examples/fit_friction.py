"""Identify a friction coefficient from a recorded motion by gradient descent."""

import torch

import gelflow.sim as gs

scene = gs.load_scene("pushing")
sim = gs.Simulator(scene)
state = gs.torch_state(sim)
u = torch.zeros((60, 1, scene.nu), dtype=torch.float64)
u[:, :, scene.u("gripper_x")] = 1.0


def motion(mu: torch.Tensor) -> torch.Tensor:
    """Position of the box over time [mm], shape (steps + 1,), for a friction coefficient of box and ground."""
    run = gs.torch_rollout(sim, state, u, params={"box_ground.mu": mu})
    return 1e3 * run.q[:, 0, scene.q("box_x").start]


with torch.no_grad():
    recorded = motion(torch.tensor(0.5, dtype=torch.float64))  # stands for a measurement

mu = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
optimizer = torch.optim.SGD([mu], lr=3e-3)
for iteration in range(7):
    optimizer.zero_grad()
    loss = (motion(mu) - recorded).square().mean()  # [mm²]
    loss.backward()
    print(f"iteration {iteration}: mu = {mu.item():.4f}, loss {loss.item():.2g} mm²", flush=True)
    optimizer.step()
