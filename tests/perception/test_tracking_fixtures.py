"""Tracking of the stored sequences with ground truth in tests/data/tracking."""

from pathlib import Path

import numpy as np
import pytest

from gelflow.perception import MarkerTracker
from gelflow.perception.sources import image_source
from gelflow.perception.synthetic.sequence_files import read_truth, truth_file

DATA = Path(__file__).parents[1] / "data" / "tracking"


@pytest.mark.parametrize(
    ("name", "kind", "median", "high"), [("press", "folder", 0.03, 0.08), ("twist.mjpeg", "video", 0.08, 0.3)]
)
def test_a_recorded_sequence_is_tracked(name: str, kind: str, median: float, high: float) -> None:
    """`median` [px] bounds the position error of the class: "typical" for the folder, "hard" for the video.

    `high` [px] bounds the 95th percentile of the displacement error, which excludes the constant position error of
    damaged dots.
    """
    source, truth = image_source(str(DATA / name)), read_truth(truth_file(DATA / name))
    assert source.kind == kind
    assert truth.made_from["appearance"]["grid"]  # the stored files have the former key "look"
    images = [frame.image for frame in source]
    assert len(images) == len(truth.position)
    tracker = MarkerTracker()
    first = tracker.start(images[0])
    assert (first.rows, first.cols) == (truth.rows, truth.cols)
    assert first.spacing == pytest.approx(truth.spacing, rel=0.03)
    tracked = [tracker.track(image) for image in images[1:]]
    valid = np.array([one.valid for one in tracked])
    off = np.linalg.norm([one.position for one in tracked] - truth.position[1:], axis=-1)
    assert np.median(off[valid]) < median
    moved = [one.displacement for one in tracked] - (truth.position[1:] - truth.position[0])
    assert np.percentile(np.linalg.norm(moved, axis=-1)[valid & first.valid], 95) < high
    visible = truth.visible[1:]
    assert (off[visible] < 0.1 * truth.spacing).mean() > 0.99
    assert not valid[:, ~truth.visible.any(axis=0)].any(), "a missing dot is never measured"
