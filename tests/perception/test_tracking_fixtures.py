"""Recorded sequences with their truth, tests/data/tracking: read as any recording is, and tracked as well as ever."""

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
    """The median error [px] is what must hold for its class: the folder is of the typical one, the video of the hard.

    `high` [px] is for the displacement's 95th percentile: where a damaged dot's middle was printed can't be seen, but
    how far it went can.
    """
    source, truth = image_source(str(DATA / name)), read_truth(truth_file(DATA / name))
    assert source.kind == kind
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
    assert not valid[:, ~truth.visible.any(axis=0)].any(), "what was never printed is never measured"
