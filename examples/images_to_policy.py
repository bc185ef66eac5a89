"""From the images of two pads to a correction of the insertion policy: `python images_to_policy.py [LEFT RIGHT]`."""

import sys
from pathlib import Path

import cv2

from gelflow.observation import flow_map
from gelflow.perception import CameraMount, MarkerTracker, tactile_frame
from gelflow.policies import default_checkpoint, load_policy
from gelflow.task import INSERTION

# Without folders, one sequence stands for both pads.
PRESS = Path(__file__).resolve().parents[1] / "tests" / "data" / "tracking" / "press"
folders = [Path(name) for name in sys.argv[1:3]] or [PRESS, PRESS]

first, last, mounts = [], [], []
for folder in folders:
    files = sorted(folder.glob("*.jpg"))
    tracker = MarkerTracker()
    first.append(tracker.start(cv2.imread(str(files[0]))))  # the first image: the part is held, without contact
    for file in files[1:]:
        result = tracker.track(cv2.imread(str(file)))
    last.append(result)  # the last image: the part presses on the rim of the hole
    mounts.append(CameraMount(result.rows, result.cols, pixels_per_mm=16.0))  # measure yours

reference, frame = tactile_frame(first, mounts, stamp=0.0), tactile_frame(last, mounts, stamp=1.0)
observation = flow_map([frame], reference, grid=INSERTION.grid)
print(f"flow map of shape {observation.image.shape}, divided by {observation.divisor:.3f} {observation.unit}")

policy = load_policy(default_checkpoint())
policy.reset()  # a new part
dx, dy, dyaw = policy.act(observation)
print(f"correction: {1e3 * dx:.2f} mm, {1e3 * dy:.2f} mm, {57.3 * dyaw:.1f}°")
