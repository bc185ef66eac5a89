"""The tracking benchmark: definitions of its metrics and of the error bound, and a short run of the command."""

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import PeerError
from gelflow.perception.benchmark.baselines import TRACKERS, MarkerEstimate
from gelflow.perception.benchmark.image_classes import CLASSES, FACTORED, SIZED, ImageClass
from gelflow.perception.benchmark.metrics import TrackedSequence, TrackingMetrics, run_trackers
from gelflow.perception.benchmark.tracking import GELFLOW, MotionResult
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.error_bound import cramer_rao_errors
from gelflow.perception.synthetic.sequences import GelSequence

SPACING = 20.0


def tracked_sequence(
    error: np.ndarray, valid: np.ndarray | None = None, visible: np.ndarray | None = None
) -> TrackedSequence:
    """A tracked sequence of 2 × 3 markers at rest, with position errors `error` of shape (frames, 6, 2)."""
    down, right = np.divmod(np.arange(6), 3)
    truth = np.repeat(SPACING * np.stack([right, down], axis=1)[None].astype(float), len(error), axis=0)
    all_of_them = np.ones(error.shape[:2], dtype=bool)
    valid, visible = (all_of_them if one is None else one for one in (valid, visible))
    return TrackedSequence(truth + error, error - error[0], valid, truth, visible, SPACING)


def test_errors_are_distances_of_measured_markers_from_the_truth() -> None:
    off = np.zeros((3, 6, 2))
    off[0] = 9.0  # the first image is excluded
    off[1, 0], off[2, 1] = (3.0, 4.0), (0.0, 1.0)
    valid = np.ones((3, 6), dtype=bool)
    valid[1, 5] = False
    one = tracked_sequence(off, valid)
    assert sorted(one.errors())[-2:] == [1.0, 5.0] and len(one.errors()) == 11
    assert sorted(one.displacement_errors())[-3:] == pytest.approx([np.hypot(9, 9)] * 3), (
        "relative to the first image, with errors of 9 px right and down"
    )
    assert one.measured() == 11 / 12 and one.near() == 11 / 12, "5 px exceed 0.1 spacings"
    assert one.identity_switches() == 0, "an error of 9 px is not the position of another marker"
    metrics = TrackingMetrics.from_sequences([one, one])
    assert (
        metrics.median == 0.0
        and metrics.near == 11 / 12
        and metrics.to_dict()["percentile_95"] == pytest.approx(3.2, abs=2)
    )


def test_identity_switches_count_measured_markers_only() -> None:
    off = np.zeros((2, 6, 2))
    off[1, 0], off[1, 1] = (SPACING, 1.0), (-SPACING, 0.0)
    assert tracked_sequence(off).identity_switches() == 2
    valid = np.ones((2, 6), dtype=bool)
    valid[1, 0] = False
    assert tracked_sequence(off, valid).identity_switches() == 1
    assert tracked_sequence(off).recovered() == pytest.approx(4 / 6)
    visible = np.ones((2, 6), dtype=bool)
    visible[:, :2] = False
    assert tracked_sequence(off, visible=visible).near() == 1.0


def test_jitter_is_a_standard_deviation_per_axis_and_drift_a_displacement() -> None:
    rng = np.random.default_rng(0)
    noise = tracked_sequence(rng.normal(0, 0.02, (4000, 6, 2)))
    assert noise.jitter() == pytest.approx(0.02, rel=0.03)
    away = np.zeros((5, 6, 2))
    away[:, :, 0] = np.linspace(0, 0.5, 5)[:, None]
    assert tracked_sequence(away).drift() == pytest.approx(0.5)
    nothing = tracked_sequence(away, np.zeros((5, 6), dtype=bool))
    assert nothing.jitter() is None and nothing.drift() is None
    assert TrackingMetrics.from_sequences([nothing]).to_dict()["median"] is None, "JSON cannot represent infinity"


def test_a_tracker_that_raises_measures_nothing_from_that_image_on() -> None:
    class Fragile:
        def start(self, image: Any, rest: np.ndarray, seen: np.ndarray, rows: int, cols: int) -> Any:
            return MarkerEstimate(rest, np.zeros_like(rest), seen)

        def track(self, image: Any) -> Any:
            raise PeerError("lost it")

    appearance = make_appearance("clean", markers=35)
    found = run_trackers(GelSequence(appearance, frames=3), 5, 7, {"fragile": Fragile()})["fragile"]
    assert found.failed == "lost it" and found.valid[0].all() and not found.valid[1:].any()
    assert found.near() == 0.0 and found.spacing == pytest.approx(appearance.spacing)
    assert TrackingMetrics.from_sequences([found]).failed == ("lost it",)


@pytest.mark.parametrize(("noise", "blur", "markers"), [(2.0, 1.0, 63), (3.0, 1.5, 130)])
def test_the_error_bound_is_the_cramer_rao_bound(noise: float, blur: float, markers: int) -> None:
    """Bound per axis for a disc with a soft edge: noise / contrast · √(2 blur / (√π radius)); rounding adds noise."""
    appearance = make_appearance("clean", noise=noise, blur=blur, markers=markers)
    errors = cramer_rao_errors(GelSequence(appearance, motion="rest", frames=19), every=3)
    bound = noise / (appearance.contrast * appearance.light) * np.sqrt(2 * blur / (np.sqrt(np.pi) * appearance.radius))
    assert 1.0 < np.sqrt((errors**2).mean() / 2) / bound < 1.25


def test_the_image_classes_have_unique_names_and_cover_all_sizes() -> None:
    names = [case.name for case in (*CLASSES, *SIZED, *FACTORED)]
    assert len(set(names)) == len(names)
    assert [case.appearance(0).quality for case in CLASSES] == [100, 90, 75, 90]
    assert {(case.markers, case.size) for case in (*CLASSES, *SIZED)} == {
        (markers, size) for markers in (63, 130, 154) for size in ((320, 240), (640, 480))
    }


def test_exceeded_bounds_are_reported() -> None:
    jumps = {name: {"press": 0.6, "twist": 0.8} for name in TRACKERS}
    result = MotionResult("typical", 0.03, None, dict.fromkeys(TRACKERS, 2), jumps)
    assert result.violations() == [
        "2 identity switches at 0.8 spacings",
        "jitter 0.030 px, must be 0.02",
        "drift none px, must be 0.05",
        "jumps of 0.6 spacings survived, must be 0.7",
    ]


def test_all_trackers_track_small_motion() -> None:
    for name, sequences in (
        ImageClass("clean", "clean", {}, 63).track(TRACKERS, ("press",), frames=6, period=12).items()
    ):
        metrics = TrackingMetrics.from_sequences(sequences)
        assert metrics.identity_switches == 0 and metrics.recovered == 1.0, name
        assert metrics.median < 0.1, name


def test_a_short_run_fits_the_terminal_and_writes_json_and_picture(tmp_path: Path) -> None:
    file, picture = tmp_path / "bench.json", tmp_path / "tracking.png"
    command = ["bench", "tracking", "--quick", "--repeats", "1", "--out", str(tmp_path)]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        main(command)
    assert max(map(len, out.getvalue().splitlines())) <= 100

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    record = json.loads(file.read_text("utf-8"), parse_constant=refuse)
    assert record["format"] == 1 and record["processor"] and "opencv-contrib-python-headless" in record["versions"]
    for case in record["tracking"]["results"]:
        assert case[GELFLOW]["identity_switches"] == 0 and case[GELFLOW]["near"] > 0.99
        assert case[GELFLOW]["median"] < case["Lucas-Kanade"]["median"], "gelflow is more accurate than Lucas-Kanade"
    assert {result["curve"] for result in record["tracking_curves"]["results"]} >= {"noise", "missing", "width"}
    assert picture.read_bytes().startswith(b"\x89PNG")
