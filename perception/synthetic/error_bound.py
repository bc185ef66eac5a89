"""The least error that any tracker can have on an image: what a fit has that knows everything but the answer.

It is given the image without noise and JPEG, and how that changes when the dots move; by least squares it finds how
far each dot seems to have moved in the noisy image, together with the dot's contrast and the light around it.
"""

import numpy as np
from numpy.typing import NDArray

from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.sequences import GelSequence

_GREY = np.array([0.114, 0.587, 0.299])  # of blue, green and red
_STEP = 0.2  # that the dots are moved to see how the image changes [px]

Array = NDArray[np.float64]


def cramer_rao_errors(sequence: GelSequence, *, every: int = 8) -> Array:
    """Endpoint errors of that fit for the visible dots of every `every`-th image [px], shape (n,)."""
    renderer = AccurateGelRenderer(sequence.appearance)
    found = []
    for number in range(0, len(sequence), every):
        still, around = sequence.displacement(number), sequence.surroundings(number)
        frame = renderer.render(still, number=number, **around)
        image, known = frame.image @ _GREY, _known(renderer, sequence, number)
        for place, visible in zip(frame.position, frame.visible, strict=True):
            error = _error(image, known, place, sequence) if visible else None
            found += [error] if error is not None else []
    return np.array(found)


def _known(renderer: AccurateGelRenderer, sequence: GelSequence, number: int) -> Array:
    """Noiseless grey image and its change with the dots' place to the right and down, shape (3, height, width)."""
    still, around = sequence.displacement(number), sequence.surroundings(number)

    def grey(right: float, down: float) -> Array:
        moved = still + np.array([down, right]) / sequence.appearance.pixels_per_mm
        return np.asarray(renderer.expose(moved, **around).picture @ _GREY)

    rightward = (grey(_STEP, 0) - grey(-_STEP, 0)) / (2 * _STEP)
    downward = (grey(0, _STEP) - grey(0, -_STEP)) / (2 * _STEP)
    return np.stack([grey(0, 0), rightward, downward])


def _error(image: Array, known: Array, place: Array, sequence: GelSequence) -> float | None:
    """Of one dot [px]; None where its surroundings are not wholly in the image."""
    appearance = sequence.appearance
    reach = int(np.ceil(1.3 * appearance.radius * np.sqrt(appearance.oval) + 2 * appearance.blur))
    right, down = (int(at) for at in np.rint(place))
    if min(right, down) < reach or right + reach >= appearance.width or down + reach >= appearance.height:
        return None
    window = np.s_[down - reach : down + reach + 1, right - reach : right + reach + 1]
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.hypot(x, y) <= reach + 0.3
    model, rightward, downward = (layer[window][disc] for layer in known)
    terms = np.stack([rightward, downward, model, np.ones_like(model)], axis=1)
    fitted = np.linalg.lstsq(terms, image[window][disc] - model, rcond=None)[0]
    return float(np.hypot(fitted[0], fitted[1]))
