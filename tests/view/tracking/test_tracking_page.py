"""The page of `gelflow track --show` in a real browser."""

import numpy as np
from tests.view.browser import browser, needs_browser

from gelflow.observation import Grid
from gelflow.perception.output.writers import TrackedImage
from gelflow.perception.sources import SourceImage
from gelflow.perception.synthetic.appearance import GelAppearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.tracker import MarkerTracker
from gelflow.view.tracking.tracking_page import TrackingPage

LOOK = GelAppearance(grid=Grid(rows=8, cols=6, pitch=2.2), width=240, height=320, noise=0.5)


@needs_browser
def test_page_shows_images_and_takes_a_new_zero() -> None:
    renderer, tracker = FastGelRenderer(LOOK), MarkerTracker()
    page = TrackingPage("a gel", magnify=3.0, forces=False, port=0)
    with browser() as window:
        window.open(page.url)
        number = 0

        def shown(text: str) -> bool:
            nonlocal number
            displacement = np.tile([0.05 * (number % 5), 0.0], (48, 1))
            image = renderer.render(displacement)
            frame = SourceImage("", image, number / 25, None)
            page.add(TrackedImage(number, frame, tracker.track(image)))
            number += 1
            return text in window.text()

        window.wait(lambda: shown("48 of 48 markers measured"))
        window.press("Zero (Z)")
        window.wait(page.take_zero_request)
        assert not page.take_zero_request()
        page.zeroed(done=True)
        window.wait(lambda: shown("zero at"))
        assert len(np.unique(window.picture()[200:, 450:].reshape(-1, 3), axis=0)) > 200  # not blank
        assert window.errors() == [] and window.foreign_requests() == []
    page.close()
