"""A film of the included policy inserting a part: the scene, the contact forces and the readings of both pads."""

import sys

import numpy as np
from PIL import Image

from gelflow.policies import default_checkpoint, load_policy
from gelflow.sim.drawing.annotations import force_scales
from gelflow.sim.drawing.renderer import Renderer
from gelflow.sim.tasks.insertion_environments import Insertion

path = sys.argv[1] if len(sys.argv) > 1 else "insertion.gif"
env, rng = Insertion(1), np.random.default_rng(3)
policy = load_policy(default_checkpoint()).network.batch_policy(1)
env.reset(env.all, rng, options={"misalignment": (5e-3, -4e-3, np.radians(6.0))})
attempts = []  # drawings of each attempt and its title
while True:
    x, y, yaw = env.attempts.pose[0]
    title = f"attempt {len(attempts) + 1}: off by {1e3 * x:+.1f}, {1e3 * y:+.1f} mm, {np.degrees(yaw):+.1f} deg"
    attempts.append((env.attempts.drawings(0, 12), title))
    if env.terminated[0] or env.truncated[0]:
        break
    env.step(policy.act(env.observation), rng)

drawings = [drawing for attempt, _ in attempts for drawing in attempt]
renderer, scales = Renderer(env.attempts.sim), force_scales(drawings)  # one camera and one scale for all pictures
camera = renderer.camera(drawings[::6], "oblique", (480, 360))
pictures = [
    Image.fromarray(renderer.draw(drawing, (480, 360), camera, scales=scales, title=title)).quantize(64)
    for attempt, title in attempts
    for drawing in attempt
]
durations = ([110] * 11 + [1000]) * len(attempts)  # [ms]: an attempt ends with a rest
pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0)
print(f"{path}: {len(attempts)} attempts, inserted {bool(env.info['success'][0])}")
