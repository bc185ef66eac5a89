"""Hints of `gelflow describe` about the step and the integrator, against closed forms."""

from pathlib import Path

import numpy as np
import pytest

from gelflow.cli.main import main
from gelflow.sim import Simulator, load_scene
from gelflow.sim.benchmark.accuracy_hints import accuracy_hints, contact_period, energy_change_per_turn
from gelflow.sim.scene import Scene

MASS, KN = 0.2, 500.0
BOX = '<geom name="{0}" type="box" size="0.02 0.03 0.04" mass="0.2"/>'


def scene(
    folder: Path, *, kn: float = KN, step: float = 1e-3, integrator: str = "bdf2", against: str = "ground"
) -> Scene:
    (folder / "s.xml").write_text(
        '<mujoco><worldbody><geom name="ground" type="plane" size="1 1 1"/>'
        f'<body name="box" pos="0 0 0.04"><freejoint/>{BOX.format("box")}</body>'
        f'<body name="slider" pos="0 0 0.2"><joint type="slide" axis="0 0 1" armature="0.1"/>{BOX.format("lid")}</body>'
        "</worldbody></mujoco>"
    )
    (folder / "s.toml").write_text(
        f'format = 1\nmodel = "s.xml"\nstep = {step}\nintegrator = "{integrator}"\n[points.box]\ngeom = "box"\n'
        f'[contacts.c]\npoints = "box"\nagainst = "{against}"\nkn = {kn}\nkt = 1\nmu = 0\nkd = 0\n'
    )
    return load_scene(folder / "s.toml")


def test_energy_of_a_turn() -> None:
    box, ball = np.diag([1.0, 2.0, 3.0]), np.eye(3)
    losses = [energy_change_per_turn(box, step, "bdf1") for step in (1e-3, 5e-4, 2.5e-4)]
    assert np.diff(np.log2(np.abs(losses))) == pytest.approx(-1, abs=0.1)
    assert losses[0] < -0.02
    assert abs(energy_change_per_turn(box, 1e-3, "bdf2")) < 1e-3
    assert energy_change_per_turn(ball, 5e-3, "bdf1") == pytest.approx(0, abs=1e-12)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert energy_change_per_turn(7 * turn @ box @ turn.T, 1e-3, "bdf1") == pytest.approx(losses[0])


def test_period_of_a_contact(tmp_path: Path) -> None:
    one = scene(tmp_path)
    assert contact_period(one, one.contacts[0]) == pytest.approx(2 * np.pi * np.sqrt(MASS / KN), rel=1e-6)
    two = scene(tmp_path, against="lid")  # on the slide the armature counts
    reduced = 1 / (1 / MASS + 1 / (MASS + 0.1))
    assert contact_period(two, two.contacts[0]) == pytest.approx(2 * np.pi * np.sqrt(reduced / KN), rel=1e-6)


def test_hints_name_what_is_resolved_poorly(tmp_path: Path) -> None:
    assert accuracy_hints(scene(tmp_path)) == ()
    (line,) = accuracy_hints(scene(tmp_path, step=5e-3, integrator="bdf1"))
    assert line.startswith("body box, where it tumbles at 30 rad/s: bdf1 with steps of 5 ms changes the energy by -")
    assert 'integrator = "bdf2"' in line
    (line,) = accuracy_hints(scene(tmp_path, kn=1e6))
    assert line.startswith("contact c: the bodies oscillate on one of its points with a period of 2.8 ms")


@pytest.mark.parametrize("integrator", ["bdf1", "bdf2"])
def test_restitution_of_an_undamped_contact_at_the_bound(integrator: str, tmp_path: Path) -> None:
    """Without damping a box rebounds at the speed of its impact; where a hint appears, much of the energy is lost."""
    kept = []
    for phase in (1.0, 2 * np.pi / 20):  # the bound of the hint, and the step that it proposes
        step = phase * np.sqrt(MASS / (4 * KN))  # on four corners
        loaded = scene(tmp_path, step=step, integrator=integrator)
        sim = Simulator(loaded)
        sim.param("gravity.z")[:] = 0
        fractions = []
        for part in np.linspace(0, 1, 8, endpoint=False):
            sim.reset()
            sim.q[0] = [0, 0, 0.04 + (0.1 + part) * step, 1, 0, 0, 0, 0]
            sim.v[0] = [0, 0, -1, 0, 0, 0, 0]
            sim.clear_history()
            sim.step(np.zeros(0), 60)
            fractions.append(sim.v[0, 2] ** 2)
        kept.append(float(np.mean(fractions)))
    print(f"{integrator}: energy kept {kept}")
    if integrator == "bdf2":
        assert kept[0] < 0.7
        assert kept[1] > 0.9
    else:
        assert kept[0] < 0.1


def test_hint_names_a_joint_that_starts_outside_its_range(tmp_path: Path) -> None:
    """The right thumb of the Allegro hand begins at 0.263 rad and its URDF, as all, starts at 0."""
    (tmp_path / "thumb.xml").write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body name="thumb"><joint name="turn" range="0.263 1.396"/>'
        '<joint name="bend" axis="0 1 0" range="0 1.6"/><geom size="0.01"/></body></worldbody></mujoco>'
    )
    (line,) = accuracy_hints(load_scene(tmp_path / "thumb.xml"))
    assert line.startswith("joint turn: starts at 0 rad, outside its range of 0.263 to 1.396 rad: its limit pushes it")


def test_hints_are_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene(tmp_path, kn=1e6)
    assert main(["describe", str(tmp_path / "s.toml"), "--no-timing"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "BDF2" in text
    assert "accuracy: docs/reference/accuracy.md" in text
    assert "contact c: the bodies oscillate" in text
