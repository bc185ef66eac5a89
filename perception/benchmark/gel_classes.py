"""Contact sheet of the classes and factors of synthetic gel images."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception.synthetic.appearance import FACTORS, PRESETS, make_appearance
from gelflow.perception.synthetic.sequences import FIELDS, GelSequence

_FRAME = 24  # of the sequence, near its peak
_COLUMNS = 4


def contact_sheet() -> NDArray[np.uint8]:
    """One labelled image per class and per factor, as a BGR image of `_COLUMNS` columns."""
    classes: list[tuple[str, str, dict[str, Any]]] = [(name, name, {}) for name in PRESETS]
    classes += [(name, "typical", changed) for name, changed in FACTORS.items()]
    tiles = [_tile(*entry, seed=k) for k, entry in enumerate(classes)]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)
    return np.vstack([np.hstack(tiles[k : k + _COLUMNS]) for k in range(0, len(tiles), _COLUMNS)])


def _tile(name: str, preset: str, changed: dict[str, Any], seed: int) -> NDArray[np.uint8]:
    """The centre of an image of a class, labelled with its name."""
    appearance = make_appearance(preset, seed=seed, **changed)
    sequence = GelSequence(appearance, FIELDS[seed % len(FIELDS)], period=48, frames=2 * _FRAME)
    image: NDArray[np.uint8] = list(sequence)[_FRAME].image[:200, 20:300]
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(image, name, (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, thickness, cv2.LINE_AA)
    return image
