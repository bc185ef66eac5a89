"""The least error that any tracker can have on an image: what a fit has that knows everything but the answer.

It is given the image without noise and JPEG, and how that changes when the dots move; by least squares it finds how
far each dot seems to have moved in the noisy image, together with the dot's contrast and the light around it.
"""

import numpy as np
from numpy.typing import NDArray

from gelflow.perception.synthetic.ground_truth import TruthRenderer
from gelflow.perception.synthetic.sequences import GelSequence

_GREY = np.array([0.114, 0.587, 0.299])  # of blue, green and red
_STEP = 0.2  # that the dots are moved to see how the image changes [px]

Array = NDArray[np.float64]


def floor_errors(sequence: GelSequence, *, every: int = 8) -> Array:
    """Endpoint errors of that fit for the visible dots of every `every`-th image [px], shape (n,)."""
    renderer = TruthRenderer(sequence.look)
    found = []
    for number in range(0, len(sequence), every):
        still, around = sequence.displacement(number), sequence.surroundings(number)
        frame = renderer.render(still, number=number, **around)
        image, known = frame.image @ _GREY, _known(renderer, sequence, number)
        for place, visible in zip(frame.position, frame.visible, strict=True):
            error = _error(image, known, place, sequence) if visible else None
            found += [error] if error is not None else []
    return np.array(found)


def _known(renderer: TruthRenderer, sequence: GelSequence, number: int) -> Array:
    """Noiseless grey image and its change with the dots' place to the right and down, shape (3, height, width)."""
    still, around = sequence.displacement(number), sequence.surroundings(number)

    def grey(right: float, down: float) -> Array:
        moved = still + np.array([down, right]) / sequence.look.pixels_per_mm
        return np.asarray(renderer.expose(moved, **around).picture @ _GREY)

    rightward = (grey(_STEP, 0) - grey(-_STEP, 0)) / (2 * _STEP)
    downward = (grey(0, _STEP) - grey(0, -_STEP)) / (2 * _STEP)
    return np.stack([grey(0, 0), rightward, downward])


def _error(image: Array, known: Array, place: Array, sequence: GelSequence) -> float | None:
    """Of one dot [px]; None where its surroundings are not wholly in the image."""
    look = sequence.look
    reach = int(np.ceil(1.3 * look.radius * np.sqrt(look.oval) + 2 * look.blur))
    right, down = (int(at) for at in np.rint(place))
    if min(right, down) < reach or right + reach >= look.width or down + reach >= look.height:
        return None
    window = np.s_[down - reach : down + reach + 1, right - reach : right + reach + 1]
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.hypot(x, y) <= reach + 0.3
    model, rightward, downward = (layer[window][disc] for layer in known)
    terms = np.stack([rightward, downward, model, np.ones_like(model)], axis=1)
    fitted = np.linalg.lstsq(terms, image[window][disc] - model, rcond=None)[0]
    return float(np.hypot(fitted[0], fitted[1]))
