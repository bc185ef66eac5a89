"""Track the printed markers of a gel through a folder of images: `python track_images.py [FOLDER]`."""

import sys
from pathlib import Path

import cv2
import numpy as np

from gelflow.perception import MarkerTracker

DEFAULT = Path(__file__).resolve().parents[1] / "tests" / "data" / "tracking" / "press"
folder = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
files = sorted(folder.glob("*.jpg"))

tracker = MarkerTracker()
result = tracker.start(cv2.imread(str(files[0])))  # the first image shows the gel at rest
print(f"{len(result.position)} markers")
for file in files[1:]:
    result = tracker.track(cv2.imread(str(file)))
    length = np.linalg.norm(result.displacement[result.valid], axis=1)  # [px]
    print(f"{file.name}: {result.valid.mean():.0%} measured, largest displacement {length.max():.2f} px")
