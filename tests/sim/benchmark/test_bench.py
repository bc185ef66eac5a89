"""`gelflow bench`: output, the timed workloads, and detection of inaccurate runs. No test checks speed."""

import contextlib
import io
import json
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.cli.commands.bench import MEASUREMENTS, conclude
from gelflow.cli.main import main
from gelflow.cli.output import Output
from gelflow.errors import UsageError
from gelflow.geometry import angles_between
from gelflow.measurement.startup import measure_startup
from gelflow.measurement.timing import BenchmarkOptions, Report, Timing, Workload, load_note, speedup, time_interleaved
from gelflow.sim.benchmark.speed.batch import measure_batch, perturb_stiffness
from gelflow.sim.benchmark.speed.gradients import measure_gradients
from gelflow.sim.benchmark.speed.markers import SHAPES, measure_markers
from gelflow.sim.benchmark.speed.mujoco_sensor import MujocoRolling
from gelflow.sim.benchmark.speed.redmax import MODULE, unavailable_reason
from gelflow.sim.benchmark.speed.rolling import (
    ROLLING_STEPS,
    RollingConfig,
    measure_rolling,
    rolling_run,
    rolling_scene,
)
from gelflow.sim.benchmark.speed.scaling import SWEEPS, exponent
from gelflow.sim.benchmark.speed.scenes import measure_scenes
from gelflow.sim.benchmark.speed.timed_run import TIMED, check_accuracy, motion_run, simulator
from gelflow.sim.scene import load_scene
from gelflow.sim.validation.reference_motions import SCENES

ONCE = BenchmarkOptions(quick=True, repeats=1)
SIMULATED = [name for name in MEASUREMENTS if name != "tracking"]


@pytest.fixture(scope="module")
def everything(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder with the file and the picture of a short run of all simulator measurements, and the printed output."""
    folder = tmp_path_factory.mktemp("bench")
    command = ["bench", *SIMULATED, "--quick", "--repeats", "1"]
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main([*command, "--out", str(folder)]) == 0
    return folder, out.getvalue()


def test_output_fits_the_terminal_and_one_file_holds_all_results(everything: tuple[Path, str]) -> None:
    folder, out = everything
    assert max(map(len, out.splitlines())) <= 80
    record = json.loads((folder / "bench.json").read_text("utf-8"))
    assert record["format"] == 1 and record["processor"] and record["versions"]["mujoco"]
    assert [name for name in record if name in MEASUREMENTS] == SIMULATED
    for name in SIMULATED:
        assert record[name]["outside"] == []
        assert record[name]["title"] in out
    assert (folder / "scaling.png").read_bytes().startswith(b"\x89PNG")


def test_every_timed_run_has_an_accuracy_check(everything: tuple[Path, str]) -> None:
    record = json.loads((everything[0] / "bench.json").read_text("utf-8"))
    checks = [run["check"] for name in ("rolling", "scenes", "gradients", "batch") for run in record[name]["results"]]
    checks += [size["check"] for sweep in record["scaling"]["results"] for size in sweep["sizes"]]
    for one in checks:
        assert one["holds"] and one["position"] <= 1e-6 and one["turn"] <= 1e-6 and one["force"] <= 1e-4
        assert one["iterations"] > 0 and one["end"] and len(one["force_sum"]) == 3
    assert all(result["touching"] == 1 for result in record["markers"]["results"])


def test_rolling_run_equals_the_published_run() -> None:
    """The end state equals that of a loop of single steps with the five forces, for every evaluation interval."""
    report = measure_rolling(ONCE, configs=[RollingConfig(5, every) for every in (1, 7, 20, 350, 0)])
    sim = simulator((scene := rolling_scene(5)).model_spec, tolerance=TIMED["viscous"])
    sim.q[:] = scene.q0
    largest = np.zeros(3)
    for step in range(350):
        x = 0.1 if 100 <= step < 150 else -0.2 if 150 <= step < 200 else 0.0
        y = 0.1 if 200 <= step < 250 else -0.2 if step >= 250 else 0.0
        sim.step(np.array([x, y, 0.2]))
        if (step + 1) % 20 == 0 and sim.tactile()[0, :, 2].sum() > largest[2]:
            largest = sim.tactile()[0].sum(0).copy()
    for result in report.results:
        np.testing.assert_array_equal(result["check"]["end"], sim.q[0])
        assert result["check"]["iterations"] == sim.iterations[0] / 350
        assert result["mujoco"]["per_second"] > 0 and result["times_as_fast_as"]["mujoco"] > 0
    assert ROLLING_STEPS == 350
    np.testing.assert_array_equal(report.results[2]["check"]["force_sum"], largest)
    assert largest[2] > 0


def test_rolling_is_compared_with_published_rates() -> None:
    result = measure_rolling(ONCE, configs=[RollingConfig(10, 5)]).results[0]
    assert result["paper"] == 5200
    assert result["times_the_paper"] == pytest.approx(result["gelflow"]["per_second"] / 5200)


def test_mujoco_taxels_are_at_the_markers() -> None:
    """Each taxel gives its depth in the ball, and the ball rolls as in gelflow within the contact compliance."""
    scene = rolling_scene(40)
    run = rolling_run(scene, 5)
    rival, sim = MujocoRolling(scene, run), simulator(scene.model_spec)
    rival.start()
    rival.execute()
    run.start(sim)
    run.execute(sim)
    np.testing.assert_allclose(rival.data.qpos[:6], sim.q[0, :6], atol=3e-3)

    down = rolling_run(scene, 5)
    pressed = MujocoRolling(scene, type(run)(run.q0, down.blocks[:20]))  # 100 steps: the pad rests on the ball
    pressed.start()
    pressed.execute()
    data = pressed.data
    taxels = scene.pads[0].positions @ data.geom("pad").xmat.reshape(3, 3).T + data.geom("pad").xpos
    depth = np.maximum(0.02 - np.linalg.norm(taxels - data.geom("ball").xpos, axis=1), 0)
    assert (depth > 0).sum() > 10
    np.testing.assert_allclose(pressed.readings[0], depth, atol=1e-7)  # mesh vertices are in single precision


def test_missing_published_simulator_is_reported() -> None:
    reason = unavailable_reason(None)
    assert reason is not None and MODULE in reason and "\n" not in reason


def test_scenes_are_timed_with_both_friction_laws() -> None:
    report = measure_scenes(ONCE, steps=20)
    assert [(r["scene"], r["friction"]) for r in report.results] == [
        (scene, law) for scene in SCENES for law in ("viscous", "elastic")
    ]
    compared = {r["scene"]: r["paper"] for r in report.results if r["paper"]}
    assert compared == {"pushing": 5400, "grasp": 1000, "insertion": 1940, "dclaw": 840}
    assert report.violations == []


def test_gradients_equal_those_of_the_converged_reference() -> None:
    report = measure_gradients(ONCE, steps=5)
    assert report.violations == [] and all(r["gradient_off"] < 1e-4 for r in report.results)
    assert [r["of"] for r in report.results] == ["end state"] * 3 + ["each reading"] * 2


def test_environments_of_a_batch_differ_except_the_first() -> None:
    scene = load_scene("insertion")
    sim = simulator(scene.model_spec, num_envs=4)
    perturb_stiffness(sim)
    stiffness = sim.param("pad_left.kn")
    assert stiffness[0] == 8e3 and len(set(stiffness.tolist())) == 4
    report = measure_batch(ONCE, sizes=[1, 3], steps=10)
    assert [r["environments"] for r in report.results] == [1, 3]
    ends = [r["check"]["end"] for r in report.results]
    assert ends[0] == ends[1], "the first environment has the scene's parameters in every batch"


def test_all_markers_are_in_contact_on_every_shape() -> None:
    report = measure_markers(ONCE, side=8)
    assert [r["shape"] for r in report.results] == list(SHAPES)
    for result in report.results:
        assert result["touching"] == 1 and result["force_sum"][2] > 0 > result["force_sum"][0]
        assert 0 < result["force_off"] < 1e-4 and 0 < result["gradient_off"] < 1e-3
    ball, grid = (next(r for r in report.results if r["shape"] == kind) for kind in ("sphere", "grid"))
    np.testing.assert_allclose(grid["force_sum"], ball["force_sum"], rtol=0.02, atol=1e-9)  # same ball


def test_single_precision_is_close_to_double_and_not_equal(everything: tuple[Path, str]) -> None:
    results = json.loads((everything[0] / "bench.json").read_text("utf-8"))["precision"]["results"]
    assert len(results) == 2 * len(SCENES)
    for result in results:
        assert 0 < result["position"] < 1e-6 and 0 < result["turn"] < 1e-5
        assert 0 < result["readings"] < 1e-3 and 0 < result["gradient"] < 5e-3


@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: sweep.name)
def test_sweep_prepares_an_accurate_run(sweep: Any) -> None:
    work, accuracy = sweep.prepare(sweep.quick[0])
    assert accuracy.holds and work.units > 0
    assert len(sweep.sizes) >= 7 and sweep.sizes[-1] > sweep.quick[-1]


def test_exponent_is_fitted_over_the_larger_half() -> None:
    sizes = [1, 10, 100, 1000]
    assert exponent(sizes, [5.0, 5.0, 1e2**1.5, 1e3**1.5]) == pytest.approx(1.5)


def test_inaccurate_run_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    """A loose Newton tolerance gives force errors above 1e-4."""
    scene = load_scene("insertion", friction="elastic")
    run = motion_run(scene, steps=60)
    right, loose = (simulator(scene.model_spec, tolerance=tolerance) for tolerance in (1e-7, 0.1))
    assert check_accuracy(run, right, scene.model_spec).violations("insertion") == []
    lines = check_accuracy(run, loose, scene.model_spec).violations("insertion")
    assert len(lines) == 1 and lines[0].startswith("insertion: ")
    report = Report("scenes", "title", (), [], "note", [], lines)
    assert conclude([report], Output()) == 1
    assert capsys.readouterr().out == f"outside the bounds: {lines[0]}\n"
    assert conclude([], Output()) == 0


def test_angles_between_quaternions() -> None:
    half = np.array([[1.0, 0, 0, 0], [np.cos(5e-9), np.sin(5e-9), 0, 0], [0, 0, 1, 0]])
    np.testing.assert_allclose(angles_between(half[0], half), [0, 1e-8, np.pi], rtol=1e-6)
    np.testing.assert_allclose(angles_between(half[0], -half), [0, 1e-8, np.pi], rtol=1e-6)


def test_workloads_are_timed_in_turn() -> None:
    calls: list[str] = []

    def noted(name: str) -> None:
        calls.append(name)
        sum(range(400_000))

    workloads = [Workload(lambda: noted("a"), 10, lambda: calls.append("prepared")), Workload(lambda: noted("b"), 10)]
    times = time_interleaved(workloads, BenchmarkOptions(repeats=3))
    rounds = [name for name, _ in groupby(call for call in calls if call != "prepared")]
    assert rounds == ["a", "b"] * 4, "once untimed, then three times"
    assert calls.count("prepared") == calls.count("a")
    assert [len(one.seconds) for one in times] == [3, 3]


def test_speedup_is_the_median_of_the_ratios_of_repeats() -> None:
    one, other = Timing((1.0, 2.0, 10.0), (1.0, 1.0, 5.0)), Timing((2.0, 6.0, 10.0), (1.0, 1.0, 1.0))
    assert speedup(one, other) == 2
    assert one.rate == 0.5 and one.cpu_share == 0.5
    assert one.quartiles == (1 / 6, 1 / 1.5)


def test_invalid_arguments_give_one_line_errors(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong, message in (
        (["rolling", "--repeats", "0"], "--repeats must be at least 1, got 0"),
        (["roling"], "no measurement 'roling'; did you mean 'rolling'?"),
        (["rolling", "--out", __file__], f"cannot write into {__file__}"),
    ):
        assert main(["bench", *wrong]) == 2
        error = capsys.readouterr().err
        assert error.startswith("gelflow bench: ") and error.count("\n") == 1
        assert message.split(";")[0] in error
    with pytest.raises(UsageError, match="at least 1"):
        BenchmarkOptions(repeats=0)
    with pytest.raises(UsageError, match="or 0 for no evaluation; got -1"):
        rolling_run(rolling_scene(5), -1)


def test_startup_is_below_its_limits() -> None:
    """Processor time beyond that of an empty program: import gelflow 0.2 s, gelflow --help 0.3 s."""
    report = measure_startup(BenchmarkOptions(repeats=3))
    assert [r["program"] for r in report.results] == [
        "python",
        "import gelflow",
        "import gelflow.sim",
        "gelflow --help",
    ]
    assert all(r["seconds"] > 0 for r in report.results)
    assert report.violations == []


def test_load_note_warns_of_a_busy_machine() -> None:
    assert load_note([Timing((1.0,), (0.99,))]) == ""
    assert "62% of a core" in load_note([Timing((1.0,), (0.62,)), Timing((2.0, 2.0), (1.24, 1.24))])
