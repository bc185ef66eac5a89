"""Accuracy of the force estimate on rendered images of objects that press on a gel."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gelflow.gel.gel_file import ElasticGel
from gelflow.perception.force.estimator import ForceEstimate, ForceEstimator
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.image_layers import Contact
from gelflow.perception.synthetic.pressed_layer import SHAPES, PressedGel, PressedLayer, Shape, random_press
from gelflow.perception.tracker import MarkerTracker

IMAGES = 16  # of a contact: the force rises in the first half, then the shear
_LARGEST = 0.6  # displacement of a marker / pitch; beyond it the force is reduced

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ForceErrors:
    """Errors of the images with contact; forces [N], moments [N m]."""

    shear: Array  # (true shear, error, deviation), shape (images, 3)
    normal: Array
    moment: Array
    seconds: Array  # CPU time of each estimate, shape (images,)

    def within(self, values: Array, relative: float, absolute: float) -> float:
        """Share of the images whose error is within either bound."""
        return float(np.mean((values[:, 1] <= absolute) | (values[:, 1] <= relative * np.abs(values[:, 0]))))


def measure_forces(
    shape: Shape,
    contacts: int,
    gel: ElasticGel,
    *,
    image_class: str = "typical",
    markers: int = 130,
    width: int = 640,
    seed: int = 0,
) -> ForceErrors:
    """Press `contacts` random objects on gels, render, track and estimate.

    `width` is that of the images [px], 4 : 3. Raises UsageError for a number of `markers` that no class of images has.
    """
    rng = np.random.default_rng((SHAPES.index(shape), seed))
    rows: list[tuple[tuple[float, ...], ...]] = []
    seconds: list[float] = []
    for number in range(contacts):
        appearance = make_appearance(
            image_class, markers=markers, width=width, height=3 * width // 4, seed=1000 * seed + number, occluders=0
        )
        layer = PressedLayer(gel, appearance.grid)
        strongest = gel.youngs_modulus * (appearance.grid.pitch * 1e-3) ** 2 * 30
        press = random_press(shape, appearance.grid, rng, normal=(0.05 * strongest, strongest))
        most = float(np.abs(layer.press(press).displacement_mm).max()) / (_LARGEST * appearance.grid.pitch)
        press = replace(press, normal=press.normal / max(1.0, most))
        renderer, tracker = AccurateGelRenderer(appearance), MarkerTracker()
        noise = 0.05 / appearance.pixels_per_mm * 1e-3
        estimator = ForceEstimator(gel, appearance.grid, noise=noise)
        tracker.start(renderer.render(np.zeros((markers, 2))).image)
        middle = (float(appearance.width) / 2, float(appearance.height) / 2)
        for image in range(1, IMAGES + 1):
            now = replace(
                press,
                normal=press.normal * min(1.0, 2 * image / IMAGES),
                ratio=press.ratio * max(0.0, 2 * image / IMAGES - 1),
            )
            truth = layer.press(now)
            touch = Contact(middle, 3 * appearance.spacing, min(1.0, image / 8))
            result = tracker.track(renderer.render(truth.displacement_mm, number=image, contact=touch).image)
            displacement = 1e-3 * (result.displacement[:, ::-1] / appearance.pixels_per_mm)
            begin = time.thread_time()
            estimate = estimator.estimate(np.nan_to_num(displacement), result.valid)
            seconds.append(time.thread_time() - begin)
            if estimate is not None:
                rows.append(_errors(truth, estimate))
    values = np.array(rows)
    return ForceErrors(values[:, 0], values[:, 1], values[:, 2], np.array(seconds))


def _errors(truth: PressedGel, estimate: ForceEstimate) -> tuple[tuple[float, ...], ...]:
    shear = float(np.linalg.norm(truth.shear))
    return (
        (shear, float(np.linalg.norm(estimate.shear - truth.shear)), float(np.linalg.norm(estimate.shear_deviation))),
        (truth.normal, abs(estimate.normal - truth.normal), estimate.normal_deviation),
        (truth.moment, abs(estimate.moment - truth.moment), estimate.moment_deviation),
    )
