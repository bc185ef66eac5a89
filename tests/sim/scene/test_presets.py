"""Presets change the accuracy of the simulation in all interfaces, but not the observation."""

import re
from pathlib import Path

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.clock import ScaledClock
from gelflow.errors import UsageError
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCell, preset_config
from gelflow.sim.scene import DEFAULT_TOLERANCE, PRESET_NAMES, load_scene, scene_names
from gelflow.sim.simulator import Simulator
from gelflow.sim.tasks.insertion import InsertionAttempts, insertion_scene
from gelflow.sim.tasks.insertion_environments import InsertionEnv, InsertionVectorEnv
from gelflow.sim.tasks.insertion_randomization import NOMINAL
from gelflow.task import INSERTION

MODEL = """<mujoco><worldbody><geom name="ground" type="plane" size="1 1 1"/><body name="ball" pos="0 0 1"><freejoint/>
<geom name="ball" type="sphere" size="0.1"/></body></worldbody></mujoco>"""
SCENE = """format = 1
model = "ball.xml"
step = 5e-3
[points.ball]
geom = "ball"
count = 50
[contacts.ball]
points = "ball"
against = "ground"
kn = 1.0
kt = 1.0
mu = 1.0
kd = 0.0
"""


def write(folder: Path, presets: str) -> Path:
    (folder / "ball.xml").write_text(MODEL)
    path = folder / "ball.toml"
    path.write_text(SCENE + presets)
    return path


@pytest.mark.parametrize("name", scene_names())
def test_presets_of_scenes_keep_markers_and_contacts(name: str) -> None:
    default = load_scene(name)
    assert tuple(default.presets) == PRESET_NAMES
    assert (default.tolerance, default.precision, default.step, default.integrator) == (
        DEFAULT_TOLERANCE,
        "double",
        5e-3,
        "bdf1",
    )
    steps = []
    for preset in PRESET_NAMES:
        scene = load_scene(name, preset=preset)
        steps.append(scene.step)
        assert (
            scene.num_markers == default.num_markers
            and scene.friction == default.friction
            and scene.precision == "double"
        )
        assert [p.grid for p in scene.pads] == [p.grid for p in default.pads]
        assert [c.params for c in scene.contacts] == [c.params for c in default.contacts]
        np.testing.assert_array_equal(scene.q0, default.q0)
    assert steps == sorted(steps, reverse=True) and len(set(steps)) == 3


def test_overrides_take_precedence_over_presets(tmp_path: Path) -> None:
    presets = """[presets.mine]
step = 2e-3
integrator = "bdf2"
tolerance = 1e-5
precision = "single"
points.ball.count = 20
[presets.other]
"points.*.count" = 30
"""
    path = write(tmp_path, presets)
    scene = load_scene(path, preset="mine")
    assert (scene.step, scene.integrator, scene.tolerance, scene.precision) == (2e-3, "bdf2", 1e-5, "single")
    assert len(scene.points[0].points) == 20 and len(load_scene(path).points[0].points) == 50
    assert len(load_scene(path, preset="other").points[0].points) == 30
    more = load_scene(path, preset="mine", overrides={"step": 1e-3, "points.ball.count": 7})
    assert more.step == 1e-3 and len(more.points[0].points) == 7
    assert scene.presets["mine"]["points.ball.count"] == 20


def test_precision_and_tolerance_reach_the_simulator(tmp_path: Path) -> None:
    path = write(tmp_path, '[presets.mine]\nprecision = "single"\n')
    assert Simulator(load_scene(path)).dtype is np.float64
    single = load_scene(path, preset="mine")
    assert Simulator(single).dtype is np.float32 and Simulator(single, precision="double").dtype is np.float64
    iterations = []
    for tolerance in (1e-2, 1e-12):
        scene = load_scene("pushing", overrides={"tolerance": tolerance})
        sim = Simulator(scene)
        sim.step(np.eye(scene.nu)[scene.u("gripper_x")], 40)
        iterations.append(int(sim.iterations[0]))
    assert iterations[0] < iterations[1]


@pytest.mark.parametrize(
    ("preset", "message"),
    [
        ("stepp = 1e-3", "presets.mine: unknown key 'stepp'; did you mean 'step'?"),
        ('friction = "elastic"', "presets.mine: unknown key 'friction'"),
        ("points.bal.count = 5", "presets.mine: 'points.bal.count': no table 'bal'; did you mean 'ball'?"),
        ("points.ball.cuont = 5", "presets.mine: 'points.ball.cuont': unknown key 'cuont'; did you mean 'count'?"),
        ("points.ball.faces = ['+z']", "presets.mine: 'points.ball.faces': unknown key 'faces'; valid names:"),
        ("pads.pad.rows = 5", "presets.mine: 'pads.pad.rows': no table 'pads'; valid names: contacts, points"),
    ],
)
def test_unknown_key_in_a_preset_suggests_the_nearest_key(tmp_path: Path, preset: str, message: str) -> None:
    """The error is raised even if the preset is not used."""
    path = write(tmp_path, f"[presets.mine]\n{preset}\n")
    with pytest.raises(UsageError, match=re.escape(f"{path}, {message}")):
        load_scene(path)


def test_invalid_preset_value_or_name_is_an_error(tmp_path: Path) -> None:
    path = write(tmp_path, '[presets.mine]\nintegrator = "bdf3"\n')
    with pytest.raises(UsageError, match="integrator is 'bdf3'; did you mean 'bdf2'"):
        load_scene(path, preset="mine")
    with pytest.raises(UsageError, match="no preset 'fats'; did you mean 'fast'"):
        load_scene("rolling", preset="fats")


def test_attempts_have_the_same_duration_and_marker_grid() -> None:
    for preset, steps in ((None, 168), ("fast", 84), ("accurate", 1342)):
        attempts = InsertionAttempts(1, scene=insertion_scene(preset=preset), randomization=NOMINAL)
        assert attempts._steps == steps
        assert attempts.scene.grids == (INSERTION.grid, INSERTION.grid)


def test_flow_maps_agree_between_presets() -> None:
    images = []
    for preset in (None, *PRESET_NAMES):
        env = InsertionVectorEnv(1, preset=preset, randomization=NOMINAL)
        image, _ = env.reset(seed=1, options={"misalignment": (4e-3, 2e-3, 0.05)})
        images.append(image)
    for image in images[:-1]:
        assert np.linalg.norm(image - images[-1]) < 0.35 * np.linalg.norm(images[-1])


def test_environments_take_a_scene_or_a_preset() -> None:
    assert InsertionEnv(preset="fast").batch.attempts.scene.step == 10e-3
    with pytest.raises(UsageError, match="scene and preset exclude each other"):
        InsertionEnv(preset="fast", scene=insertion_scene())
    with pytest.raises(UsageError, match="no preset 'quick'"):
        InsertionVectorEnv(1, preset="quick")


@pytest.mark.parametrize("preset", PRESET_NAMES)
def test_simulated_cell_step_divides_4_ms(preset: str) -> None:
    config = preset_config(preset, seed=3)
    assert config.step <= load_scene("insertion", preset=preset).step
    assert round(4e-3 / config.step) * config.step == pytest.approx(4e-3)
    world = SimulatedCell(ScaledClock(), config)
    world.command_gripper(width=0.03, speed=0.05, force=12.0)
    world.advance(round(0.7 / config.step))
    part = world.truth()["part"]
    world.advance(round(0.5 / config.step))
    assert part["phase"] == "gripped"
    assert world.truth()["part"]["phase"] == "gripped"
    assert abs(world.truth()["part"]["slip"][0]) < 1e-3


@pytest.mark.parametrize("command", ["train insertion", "eval insertion", "mock", "describe insertion", "demo"])
def test_command_line_reports_an_unknown_preset(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out")] if command.split()[0] in ("train", "demo") else []
    assert main([*command.split(), "--preset", "fats", *out]) == 2
    assert "no preset 'fats'; did you mean 'fast'?" in capsys.readouterr().err


def test_describe_shows_the_preset(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["describe", "insertion", "--preset", "fast", "--no-timing"]) == 0
    assert "steps of 10 ms" in capsys.readouterr().out
