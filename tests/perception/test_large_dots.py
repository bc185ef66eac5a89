"""Dots over which the displacement is curved, and large dots, which are fitted again at the full resolution."""

import numpy as np
import pytest

from gelflow.perception import MarkerTracker
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.sequences import GelSequence

LARGE = {"markers": 63, "width": 640, "height": 480}  # dots with a radius of 11.4 px


@pytest.mark.parametrize(("width", "height", "offset"), [(320, 240, 0.03), (640, 480, 0.06)])
def test_markers_are_where_the_centres_of_the_dots_have_moved(width: int, height: int, offset: float) -> None:
    appearance = make_appearance("clean", markers=63, width=width, height=height)
    renderer, tracker, rest = AccurateGelRenderer(appearance), MarkerTracker(), appearance.positions_mm()
    at = rest - rest.mean(axis=0)
    still = renderer.render(np.zeros_like(rest))
    tracker.start(still.image)
    # The displacement c (x², y²) moves the centre of the outline of a dot with radius r by 3/4 c r² along each axis.
    curvature = 0.3 / (2 * np.abs(at).max())
    radius_mm = appearance.radius / appearance.pixels_per_mm
    assert np.sqrt(2) * 0.75 * curvature * radius_mm**2 * appearance.pixels_per_mm > offset
    errors = []
    for number, share in enumerate((0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0, 1.0), start=1):
        frame = renderer.render(share * curvature * at**2, number=number)
        tracked = tracker.track(frame.image)
        assert tracked.valid[frame.visible].all()
        if share == 1.0:
            errors.append(tracked.displacement - (frame.position - still.position))
    inner = np.arange(63).reshape(7, 9)[1:-1, 1:-1].ravel()
    assert np.linalg.norm(np.mean(errors, axis=0)[inner].mean(axis=0)) < 0.25 * offset


@pytest.mark.parametrize("bright", [False, True])
def test_large_ovals_are_fitted_in_the_image_that_is_not_downsampled(bright: bool) -> None:
    appearance = make_appearance("clean", seed=3, oval=2.2, bright=bright, **LARGE)
    tracker, errors = MarkerTracker(), []
    for frame in GelSequence(appearance, "twist", frames=10, period=12):
        tracked = tracker.track(frame.image)
        assert tracked.valid[frame.visible].all()
        errors.append(np.linalg.norm(tracked.position - frame.position, axis=1)[tracked.valid])
    # In the downsampled image they are .015 and .054 px.
    assert np.median(np.concatenate(errors)) < 0.013 and np.quantile(np.concatenate(errors), 0.95) < 0.045


def test_positions_are_the_rest_positions_plus_the_displacements() -> None:
    appearance = make_appearance("hard", seed=1, **LARGE)
    tracker = MarkerTracker()
    for frame in GelSequence(appearance, "press", frames=12, period=12):
        tracked = tracker.track(frame.image)
        np.testing.assert_allclose(tracked.position, tracker.rest + tracked.displacement, rtol=0, atol=1e-9)


def test_large_dots_that_disappear_are_not_measured_and_found_again() -> None:
    appearance = make_appearance("typical", seed=1, **LARGE)
    renderer, tracker, still = AccurateGelRenderer(appearance), MarkerTracker(), np.zeros((63, 2))
    tracker.start(renderer.render(still).image)
    before = tracker.track(renderer.render(still, number=1).image)
    dark = tracker.track(np.full((480, 640, 3), 90, np.uint8))
    assert not dark.valid.any() and np.isnan(dark.displacement).all() and np.isfinite(dark.position).all()
    after = tracker.track(renderer.render(still, number=2).image)
    assert after.valid.all() and np.abs(after.displacement - before.displacement).max() < 0.2
