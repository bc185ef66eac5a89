"""One episode of the insertion task with random actions, through Gymnasium."""

import gymnasium

import gelflow  # noqa: F401 - registers the environments

env = gymnasium.make("gelflow/Insertion-v0")
observation, info = env.reset(seed=0)
env.action_space.seed(0)
while True:
    action = env.action_space.sample()  # correction in x, y, yaw, scaled to [-1, 1]
    observation, reward, terminated, truncated, info = env.step(action)
    print(f"attempt {info['attempts']}: reward {reward:.3f}, inserted {bool(info['inserted'])}")
    if terminated or truncated:
        break
env.close()
