"""Dots in uneven, coloured light: the image plane in which they are measured, and dots on wrinkles."""

import numpy as np
import pytest

from gelflow.perception import MarkerTracker
from gelflow.perception.grid_detection.grid import find_grid
from gelflow.perception.grid_detection.grid_part import GridRequest
from gelflow.perception.synthetic import make_appearance
from gelflow.perception.synthetic.sequences import GelSequence


def test_large_dots_on_wrinkles_are_measured() -> None:
    errors, measured, visible = [], 0, 0
    intact = {"damaged": 0.0, "bridges": 0, "missing": 0.0, "occluders": 0}
    for seed in range(3):
        appearance = make_appearance("hard", markers=63, width=640, height=480, seed=seed, ridges=1.0, **intact)
        first, *others = GelSequence(appearance, "shear", frames=12, period=18)
        tracker = MarkerTracker()
        tracker.start(first.image)
        for rendered in others:
            tracked = tracker.track(rendered.image)
            valid = tracked.valid & rendered.visible
            error = np.linalg.norm(tracked.displacement - (rendered.position - first.position), axis=1)
            errors.append(error[valid])
            measured, visible = measured + int(valid.sum()), visible + int(rendered.visible.sum())
    error = np.concatenate(errors)
    # With a linear background alone, the 95th percentile is 0.6 px.
    assert np.median(error) < 0.06 and np.percentile(error, 95) < 0.45
    assert measured > 0.985 * visible


@pytest.mark.parametrize("seed", range(6))
def test_missing_dots_do_not_change_the_image_plane(seed: int) -> None:
    appearance = make_appearance("typical", seed=seed, missing=0.15)
    first = next(iter(GelSequence(appearance, "press", frames=1)))
    # The plane of the largest channel has twice the noise, and shows the dots about as clearly.
    assert find_grid(first.image, GridRequest()).appearance.plane == "grey"
