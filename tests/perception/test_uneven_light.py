"""Dots on wrinkles and on the bright rim of a contact, where the light changes within a dot."""

import numpy as np

from gelflow.perception import MarkerTracker
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
