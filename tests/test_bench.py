"""`gelflow bench rolling`: what it prints, and that what it times is the run of the paper. No test looks at speed."""

import json

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.sim.benchmark import ROLLING_STEPS, rolling_speed
from gelflow.sim.scene import load_scene
from gelflow.sim.simulator import Simulator

CELLS = [(100, 5), (100, 20), (2500, 5), (2500, 20), (40000, 5), (40000, 20)]


def test_json_holds_every_cell(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "rolling", "--json", "--repeats", "1"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert [(r["markers"], r["every"]) for r in results] == CELLS
    paper = [r["paper_simulator"] for r in results]
    assert paper == [5200, None, 4400, None, 1400, 3100]
    for result in results:
        assert result["steps_per_second"] > 0
        if result["paper_simulator"]:
            assert result["ratio"] == pytest.approx(result["steps_per_second"] / result["paper_simulator"])
        # Markers do not push back: all cells take the same steps, and end where the first one ends.
        assert result["end_position"] == results[0]["end_position"]
        assert result["newton_iterations"] == results[0]["newton_iterations"] >= 1


def test_the_table_has_a_row_for_every_cell(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "rolling", "--repeats", "1"]) == 0
    out = capsys.readouterr().out
    assert all(f"│ {markers:>7} │ {every:>10} │" in out for markers, every in CELLS)
    assert max(map(len, out.splitlines())) <= 80


def test_the_run_is_the_paper_s() -> None:
    """Ends where a plain loop of single steps under the five forces ends, at every interval of reading."""
    speeds = rolling_speed(sides=[5], every=[1, 7, 20, 350], repeats=1)
    scene = load_scene("rolling", friction="viscous", overrides={"pads.pad.rows": 5, "pads.pad.cols": 5})
    sim = Simulator(scene, threads=1)
    sim.q[:] = scene.q0
    compression = 0.0
    for step in range(350):
        x = 0.1 if 100 <= step < 150 else -0.2 if 150 <= step < 200 else 0.0
        y = 0.1 if 200 <= step < 250 else -0.2 if step >= 250 else 0.0
        sim.step(np.array([x, y, 0.2]))
        if (step + 1) % 20 == 0:
            compression = max(compression, float(sim.tactile()[0, :, 2].sum()))
    for speed in speeds:
        np.testing.assert_array_equal(speed.end_position, sim.q[0])
    assert ROLLING_STEPS == 350
    assert speeds[2].compression == compression > 0


@pytest.mark.parametrize("wrong", [{"repeats": 0}, {"sides": [0]}, {"every": [5, 0]}, {"every": []}])
def test_numbers_below_one_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="at least 1"):
        rolling_speed(**wrong)  # type: ignore[arg-type]


def test_the_command_refuses_wrong_input_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "rolling", "--repeats", "0"]) == 2
    assert capsys.readouterr().err == "gelflow bench: --repeats must be at least 1, got 0\n"
    with pytest.raises(SystemExit) as refused:
        main(["bench", "flying"])
    assert refused.value.code == 2
