"""Errors of an efficient estimator of dot positions: the Cramér-Rao bound of tracking on rendered images.

The estimator knows the noiseless image and its derivatives with respect to the dot positions. It fits the displacement
of each dot, its contrast and the background brightness to the noisy image by linear least squares. For white Gaussian
noise its variance attains the Cramér-Rao bound.
"""

import numpy as np
from numpy.typing import NDArray

from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.sequences import GelSequence

_GREY = np.array([0.114, 0.587, 0.299])  # luminance weights of blue, green and red
_STEP = 0.2  # of the finite differences of the image [px]

Array = NDArray[np.float64]


def cramer_rao_errors(sequence: GelSequence, *, every: int = 8) -> Array:
    """Endpoint errors of the efficient estimator for the visible dots of every `every`-th image [px], shape (n,)."""
    renderer = AccurateGelRenderer(sequence.appearance)
    errors = []
    for number in range(0, len(sequence), every):
        displacement, arguments = sequence.displacement(number), sequence.render_arguments(number)
        frame = renderer.render(displacement, number=number, **arguments)
        image, model = frame.image @ _GREY, _model(renderer, sequence, number)
        for position, visible in zip(frame.position, frame.visible, strict=True):
            error = _error(image, model, position, sequence) if visible else None
            errors += [error] if error is not None else []
    return np.array(errors)


def _model(renderer: AccurateGelRenderer, sequence: GelSequence, number: int) -> Array:
    """Noiseless grey image and its derivatives by the dot position (right, down), shape (3, height, width)."""
    displacement, arguments = sequence.displacement(number), sequence.render_arguments(number)

    def grey(right: float, down: float) -> Array:
        moved = displacement + np.array([down, right]) / sequence.appearance.pixels_per_mm
        return np.asarray(renderer.render_noiseless(moved, **arguments).picture @ _GREY)

    rightward = (grey(_STEP, 0) - grey(-_STEP, 0)) / (2 * _STEP)
    downward = (grey(0, _STEP) - grey(0, -_STEP)) / (2 * _STEP)
    return np.stack([grey(0, 0), rightward, downward])


def _error(image: Array, model: Array, position: Array, sequence: GelSequence) -> float | None:
    """Error of one dot [px]; None when its window is not entirely inside the image."""
    appearance = sequence.appearance
    reach = int(np.ceil(1.3 * appearance.radius * np.sqrt(appearance.oval) + 2 * appearance.blur))
    right, down = (int(at) for at in np.rint(position))
    if min(right, down) < reach or right + reach >= appearance.width or down + reach >= appearance.height:
        return None
    window = np.s_[down - reach : down + reach + 1, right - reach : right + reach + 1]
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc = np.hypot(x, y) <= reach + 0.3
    noiseless, rightward, downward = (layer[window][disc] for layer in model)
    terms = np.stack([rightward, downward, noiseless, np.ones_like(noiseless)], axis=1)
    fitted = np.linalg.lstsq(terms, image[window][disc] - noiseless, rcond=None)[0]
    return float(np.hypot(fitted[0], fitted[1]))
