"""Draws docs/pictures/gel_classes.jpg: what the image classes and factors of `gelflow render` look like.

python benchmarks/gel_classes.py [FILE]
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from gelflow.perception.synthetic.appearance import FACTORS, PRESETS, make_appearance
from gelflow.perception.synthetic.sequences import FIELDS, GelSequence

FILE = Path(__file__).parents[1] / "docs" / "pictures" / "gel_classes.jpg"
SHOWN = 24  # number of the image: near the peak
ACROSS = 4


def tile(name: str, preset: str, changed: dict[str, object], seed: int) -> np.ndarray:
    """Most of one image, with its name."""
    look = make_appearance(preset, seed=seed, **changed)
    sequence = GelSequence(look, FIELDS[seed % len(FIELDS)], period=48, frames=2 * SHOWN)
    image = list(sequence)[SHOWN].image[:200, 20:300]
    cv2.putText(image, name, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(image, name, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return image


def main() -> None:
    shown = [(name, name, {}) for name in PRESETS] + [(name, "typical", changed) for name, changed in FACTORS.items()]
    tiles = [tile(*one, seed=k) for k, one in enumerate(shown)]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % ACROSS)
    sheet = np.vstack([np.hstack(tiles[k : k + ACROSS]) for k in range(0, len(tiles), ACROSS)])
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else FILE
    cv2.imwrite(str(file), sheet, [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(file)


if __name__ == "__main__":
    main()
