"""The page of a simulator in a real browser."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest
from tests.view.browser import Browser, browser, needs_browser

import gelflow.sim as gs
from gelflow.view.simulation_page import SimulationPage

pytestmark = needs_browser


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    with browser() as opened:
        yield opened


def test_page_shows_the_scene_and_follows_a_step(window: Browser) -> None:
    scene = gs.load_scene("rolling", overrides={"pads.pad.rows": 20, "pads.pad.cols": 20})
    done = threading.Event()
    # Another address than 127.0.0.1 would need a name of this machine; the token is asked for on 0.0.0.0 too.
    with SimulationPage(gs.Simulator(scene), host="0.0.0.0", port=0, controls=True) as page:
        token = page.url.partition("?token=")[2]
        loop = threading.Thread(target=lambda: page.run(until=done.is_set))
        loop.start()
        try:
            window.open(f"http://127.0.0.1:{page._page.port}/?token={token}")
            window.wait(lambda: "0 steps" in window.text())
            window.wait(lambda: len(np.unique(window.picture()[:, :450].reshape(-1, 3), axis=0)) > 200)  # not blank
            before = window.picture()
            window.press("Single step")
            window.wait(lambda: ", 1 steps" in window.text())
            window.press("Play")
            window.wait(lambda: page._steps > 60)
            window.press("Pause")
            window.wait(lambda: not page.playing)
            window.wait(lambda: "contact force, orange arrow" in window.text().lower())
            scene_now, scene_before = (picture[150:, :450].astype(int) for picture in (window.picture(), before))
            assert (np.abs(scene_now - scene_before).max(-1) > 40).sum() > 100
            assert window.errors() == []
            assert window.foreign_requests() == []
        finally:
            done.set()
            loop.join()
