"""`gelflow bench tracking`: what it calls an error, an exchange or a floor is that, and a short run holds together.

No test looks at speed.
"""

import contextlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import PeerError
from gelflow.perception.benchmark.baselines import FOLLOWERS
from gelflow.perception.benchmark.metrics import Course, Figures, follow
from gelflow.perception.benchmark.tracking import CLASSES, FACTORED, OWN, SIZED, Case, Motion
from gelflow.perception.synthetic.appearance import make_appearance
from gelflow.perception.synthetic.error_bound import cramer_rao_errors
from gelflow.perception.synthetic.sequences import GelSequence

SPACING = 20.0


def course(found: np.ndarray, valid: np.ndarray | None = None, visible: np.ndarray | None = None) -> Course:
    """Of found places over (frames, 2 × 3 markers) that in truth never move."""
    down, right = np.divmod(np.arange(6), 3)
    truth = np.repeat(SPACING * np.stack([right, down], axis=1)[None].astype(float), len(found), axis=0)
    all_of_them = np.ones(found.shape[:2], dtype=bool)
    valid, visible = (all_of_them if one is None else one for one in (valid, visible))
    return Course(truth + found, found - found[0], valid, truth, visible, SPACING)


def test_errors_are_distances_of_what_is_measured() -> None:
    off = np.zeros((3, 6, 2))
    off[0] = 9.0  # the first image does not count
    off[1, 0], off[2, 1] = (3.0, 4.0), (0.0, 1.0)
    valid = np.ones((3, 6), dtype=bool)
    valid[1, 5] = False
    one = course(off, valid)
    assert sorted(one.errors())[-2:] == [1.0, 5.0] and len(one.errors()) == 11
    assert sorted(one.displacement_errors())[-3:] == pytest.approx([np.hypot(9, 9)] * 3), (
        "from a first image that was off by 9 px right and down"
    )
    assert one.measured() == 11 / 12 and one.near() == 11 / 12, "5 px are more than 0.1 of 20 px"
    assert one.exchanged() == 0, "9 px off is nobody else's place"
    figures = Figures.of([one, one])
    assert figures.median == 0.0 and figures.near == 11 / 12 and figures.plain()["high"] == pytest.approx(3.2, abs=2)


def test_an_exchange_is_seen_where_it_is_claimed_as_measured() -> None:
    off = np.zeros((2, 6, 2))
    off[1, 0], off[1, 1] = (SPACING, 1.0), (-SPACING, 0.0)
    assert course(off).exchanged() == 2
    valid = np.ones((2, 6), dtype=bool)
    valid[1, 0] = False
    assert course(off, valid).exchanged() == 1
    assert course(off).recovered() == pytest.approx(4 / 6)
    visible = np.ones((2, 6), dtype=bool)
    visible[:, :2] = False
    assert course(off, visible=visible).near() == 1.0


def test_jitter_is_along_an_axis_and_drift_is_from_rest() -> None:
    rng = np.random.default_rng(0)
    noise = course(rng.normal(0, 0.02, (4000, 6, 2)))
    assert noise.jitter() == pytest.approx(0.02, rel=0.03)
    away = np.zeros((5, 6, 2))
    away[:, :, 0] = np.linspace(0, 0.5, 5)[:, None]
    assert course(away).drift() == pytest.approx(0.5)
    nothing = course(away, np.zeros((5, 6), dtype=bool))
    assert nothing.jitter() is None and nothing.drift() is None
    assert Figures.of([nothing]).plain()["median"] is None, "JSON has no infinity"


def test_a_tracker_that_gives_up_has_nothing_from_there_on() -> None:
    class Fragile:
        def start(self, image: Any, rest: np.ndarray, seen: np.ndarray, rows: int, cols: int) -> Any:
            return rest, np.zeros_like(rest), seen

        def track(self, image: Any) -> Any:
            raise PeerError("lost it")

    appearance = make_appearance("clean", markers=35)
    found = follow(GelSequence(appearance, frames=3), 5, 7, {"fragile": Fragile()})["fragile"]
    assert found.failed == "lost it" and found.valid[0].all() and not found.valid[1:].any()
    assert found.near() == 0.0 and found.spacing == pytest.approx(appearance.spacing)
    assert Figures.of([found]).failed == ("lost it",)


@pytest.mark.parametrize(("noise", "blur", "markers"), [(2.0, 1.0, 63), (3.0, 1.5, 130)])
def test_the_floor_is_that_of_cramer_and_rao(noise: float, blur: float, markers: int) -> None:
    """Of a disc with a soft edge, per axis: noise / contrast · √(2 blur / (√π radius)); rounding adds a little."""
    appearance = make_appearance("clean", noise=noise, blur=blur, markers=markers)
    errors = cramer_rao_errors(GelSequence(appearance, motion="rest", frames=19), every=3)
    bound = noise / (appearance.contrast * appearance.light) * np.sqrt(2 * blur / (np.sqrt(np.pi) * appearance.radius))
    assert 1.0 < np.sqrt((errors**2).mean() / 2) / bound < 1.25


def test_the_cases_are_those_that_must_hold() -> None:
    names = [case.name for case in (*CLASSES, *SIZED, *FACTORED)]
    assert len(set(names)) == len(names)
    assert [case.appearance(0).quality for case in CLASSES] == [100, 90, 75]
    assert {(case.markers, case.size) for case in (*CLASSES, *SIZED)} == {
        (markers, size) for markers in (63, 130, 154) for size in ((320, 240), (640, 480))
    }


def test_what_does_not_hold_is_told() -> None:
    jumps = {name: {"press": 0.6, "twist": 0.8} for name in FOLLOWERS}
    wrong = Motion("typical", 0.03, None, dict.fromkeys(FOLLOWERS, 2), jumps)
    assert wrong.missed() == [
        "2 markers exchanged on the way to 0.8 of the spacing",
        "jitter 0.030 px, must be 0.02",
        "drift none px, must be 0.05",
        "jumps of 0.6 of the spacing survived, must be 0.7",
    ]


def test_the_baselines_follow_small_motion() -> None:
    for name, courses in Case("clean", "clean", {}, 63).follow(FOLLOWERS, ("press",), frames=6, period=12).items():
        figures = Figures.of(courses)
        assert figures.exchanged == 0 and figures.recovered == 1.0, name
        assert figures.median < 0.1, name


def test_a_short_run_fits_the_terminal_and_lands_in_a_file(tmp_path: Path) -> None:
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
        assert case[OWN]["exchanged"] == 0 and case[OWN]["near"] > 0.99
        assert case[OWN]["median"] < case["Lucas-Kanade"]["median"], "the reason why there is an own tracker"
    assert {result["curve"] for result in record["tracking_curves"]["results"]} >= {"noise", "missing", "width"}
    assert picture.read_bytes().startswith(b"\x89PNG")
