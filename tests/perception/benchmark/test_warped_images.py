"""Errors on warped first images, on rendered ones."""

import numpy as np

from gelflow.perception.benchmark.warped_images import measure_warped
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.sequences import GelSequence


def test_errors_on_warped_images_are_those_on_rendered_ones() -> None:
    (frame,) = list(GelSequence(make_appearance("typical", markers=63), frames=1))
    errors = measure_warped("rendered", frame.image)
    assert errors.markers == 63
    assert errors.gelflow < 0.12 and errors.gelflow_shaded < 0.12
    # Under changing light, optical flow moves with the shading.
    assert errors.lucas_kanade < 0.5 and errors.lucas_kanade_shaded > 2 * errors.gelflow_shaded
    assert np.isfinite([errors.lucas_kanade, errors.lucas_kanade_shaded]).all()
