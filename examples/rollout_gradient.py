"""Gradient of a tactile loss with respect to all controls of a rollout."""

import torch

import gelflow.sim as gs

scene = gs.load_scene("pushing")
sim = gs.Simulator(scene)

steps = 40
u = torch.zeros((steps, 1, scene.nu), dtype=torch.float64)  # (steps, environments, controls)
u[:, :, scene.u("gripper_x")] = 1.0
u.requires_grad_()

run = gs.torch_rollout(sim, gs.torch_state(sim), u, read_after=(20, 40))
loss = run.tactile.square().sum()  # tactile: (readings, environments, markers, 3) [N]
loss.backward()

assert u.grad is not None
print(f"loss {loss.item():.4g} N², gradient by the first push {u.grad[0, 0, scene.u('gripper_x')].item():.4g} N")
