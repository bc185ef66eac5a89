"""The pixels that a fit uses: they move with the dot, and include all of a long one."""

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.perception import MarkerTracker
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.appearance import make_appearance

Image = NDArray[np.uint8]


def test_whole_pixels_are_measured_as_such_on_an_uneven_background() -> None:
    appearance = make_appearance("clean", seed=2, markers=130, width=320, height=240)
    still = AccurateGelRenderer(appearance).render(np.zeros((130, 2))).image
    down, right = np.mgrid[:240, :320]
    uneven = 0.85 + 0.15 * np.sin(2 * np.pi * (right + 0.4 * down) / 17)
    image = (still * uneven[..., None]).round().astype(np.uint8)

    def view(right: int, down: int) -> Image:
        return np.ascontiguousarray(image[8 + down : 232 + down, 8 + right : 312 + right])

    tracker = MarkerTracker()
    first = tracker.start(view(0, 0))
    inner = np.arange(130).reshape(first.rows, first.cols)[1:-1, 1:-1].ravel()
    for moved in [(1, 0), (3, -2), (-1, 2), (0, -1)]:
        tracked = tracker.track(view(*moved))
        assert tracked.valid[inner].all()
        # .19 px if the square around a dot moved by whole pixels only.
        assert np.abs(tracked.displacement + moved)[inner].max() < 0.03


def wide_angle(moved: tuple[float, float], rng: np.random.Generator) -> Image:
    """63 dark ovals; the last ones of each row are 2.6 times as long as the first ones, and further apart."""
    width, height, fine, bits = 640, 480, 4, 8
    drawn = np.full((height * fine, width * fine), 170, np.uint8)

    def fixed_point(*values: float) -> list[int]:
        return [round(value * fine * 2**bits) for value in values]

    for row in range(7):
        for col in range(9):
            part = col / 8
            right, down = 50 + 530 * part * (0.55 + 0.45 * part) + moved[0], 50 + 62 * row + moved[1]
            half = fixed_point(18 * (0.55 + 0.9 * part), 9 * (1 + 0.3 * part))
            cv2.ellipse(
                drawn, fixed_point(right + 0.5, down + 0.5), half, 0, 0, 360, (60,), cv2.FILLED, cv2.LINE_AA, bits
            )
    image = cv2.GaussianBlur(cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA), (0, 0), 1.2)
    noisy = image[..., None] + rng.normal(0, 1, (height, width, 3))
    return np.asarray(noisy.clip(0, 255).round(), np.uint8)


def test_the_long_dots_of_a_wide_angle_lens_are_not_cut() -> None:
    rng, tracker, errors = np.random.default_rng(0), MarkerTracker(), []
    tracker.start(wide_angle((0, 0), rng), 7, 9)
    for moved in [(4.75, 2.5), (5.75, 4.25), (2.5, 5.0), (-2.75, 4.5), (-5.75, 3.0), (-4.75, 0.75), (0.0, -1.75)]:
        tracked = tracker.track(wide_angle(moved, rng))
        assert tracked.valid.all()
        errors.append(np.linalg.norm(tracked.displacement - moved, axis=1))
    # With windows that fit a typical dot they are .13 and .22 px.
    assert np.quantile(errors, 0.95) < 0.04 and np.max(errors) < 0.08
