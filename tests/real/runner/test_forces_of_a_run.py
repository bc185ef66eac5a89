"""Forces during a run on the mock robot whose world has a gel file: recorded, and compared with the true forces."""

import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.real.runner.harness import FACTOR, OraclePolicy, free_port, plan_for

from gelflow.cli.insertion_text import insertion_to_json
from gelflow.cli.main import main
from gelflow.gel.gel_file import ElasticGel, save_gel
from gelflow.hardware_mocks.robot import MockRobot, MockRobotConfig
from gelflow.hardware_mocks.simulated_cell.cell import SimulatedCellConfig
from gelflow.hardware_mocks.simulated_cell.world import Gels, World
from gelflow.mock_lab.lab import lab_for
from gelflow.real.runner.insertion.attempt import Attempt, Insertion
from gelflow.real.runner.run_plan import run_insertions
from gelflow.session.reader import SessionReader

GEL = ElasticGel(3e5, 0.48, 3e-3)
GRIP = 12.0  # [N]


def test_forces_on_the_pads_are_recorded_and_true(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_gel(GEL, tmp_path / "gel.toml")
    world = World(gels=Gels(file=str(tmp_path / "gel.toml")))
    config = MockRobotConfig(cell=SimulatedCellConfig(seed=2, world=world), egm_port=free_port(socket.SOCK_DGRAM))
    true: list[Any] = []  # forces on both pads at each decision [N]: to the tip, across, into the pad
    with MockRobot(FACTOR, config) as robot:
        lab = lab_for(robot)
        assert lab.cameras.left.elastic_gel == ElasticGel(3e5, 0.48, 3e-3, friction=1.5)
        policy = OraclePolicy(robot, answer=lambda: true.append(robot.cell.truth()["pad_forces"]))
        plan = plan_for(robot, tmp_path, policy, lab=lab)
        result = run_insertions(plan)[0]
    assert result.inserted and true

    # At the end of an attempt, at rest: the same contact. On a busy computer some estimates are late and missing.
    for attempt, pads in zip(result.attempts, true, strict=False):
        for side, force in attempt.pad_forces.items():
            x, y, normal = pads[("left", "right").index(side)]
            assert force["normal"] == pytest.approx(normal, rel=0.1)
            np.testing.assert_allclose(force["shear"], [-y, x], atol=0.15)  # right and down in the image

    with SessionReader(plan.session) as session:
        gels = session.description()["gels"]
        records = list(session.records(["/left/force", "/right/force", "/event"]))
    assert [gel["youngs_modulus"] for gel in gels] == [3e5, 3e5]
    times = {record.value["name"]: record.stamp for record in records if record.topic == "/event"}
    for topic in ("/left/force", "/right/force"):
        held = [r for r in records if r.topic == topic and times["grasp checked"] < r.stamp]
        assert held and all(r.time >= r.stamp for r in held)
        assert np.median([r.value["normal"] for r in held if r.value["contact"]]) == pytest.approx(GRIP, rel=0.1)

    assert main(["track", str(plan.session), "--images", "5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gel"].startswith("of the left pad in the session's lab, 300000 Pa")


def test_attempts_show_the_forces_on_pads_with_a_gel() -> None:
    record = {
        "contact": True,
        "normal": 12.0,
        "normal_deviation": 0.7,
        "shear": [0.1, 0.3],
        "shear_deviation": [0.1, 0.1],
    }
    attempt = Attempt(0, (0.0, 0.0, 0.0), 1e-3, 0.1, True, True, False, 5.0)
    known = replace(attempt, force=(None, record))
    values = insertion_to_json(Insertion(0, "not inserted", (0.0, 0.0, 0.0), 9.0, (attempt, known)))["attempts"]
    assert "force" not in values[0] and "force" not in attempt.summary(0)
    assert values[1]["force"] == {"right": {key: value for key, value in record.items() if key != "contact"}}
    assert known.summary(0)["force"] == {"right": record}
