"""The page of a training or an evaluation in a real browser."""

import threading
from collections.abc import Sequence

import numpy as np
from tests.view.browser import browser

from gelflow.view.training.training_page import Training, TrainingPage


def check_page(shown: Training, *, texts: Sequence[str], film: str) -> None:
    """Asserts that the page shows all `texts` and the film, without an error and without a foreign request."""
    ended = threading.Event()
    with TrainingPage(shown, port=0) as page, browser() as window:
        loop = threading.Thread(target=lambda: page.run(until=ended.is_set))
        loop.start()
        try:
            window.open(page.url)
            window.wait(lambda: all(text in window.text() for text in texts))
            window.wait(lambda: f"{film}: picture" in window.text())
            assert window.errors() == []
            assert window.foreign_requests() == []
            assert len(np.unique(window.picture().reshape(-1, 3), axis=0)) > 500  # not blank
        finally:
            ended.set()
            loop.join()
