"""Budgets of an attempt: its time is limited."""

from dataclasses import replace
from pathlib import Path

import pytest
from tests.real.runner.harness import OraclePolicy, events, plan_for

from gelflow.errors import PeerTimeout
from gelflow.hardware_mocks.robot import MockRobot
from gelflow.mock_lab.lab import lab_for
from gelflow.real.runner.run_plan import run_insertions


def test_time_of_an_attempt_is_limited(robot: MockRobot, tmp_path: Path) -> None:
    lab = lab_for(robot)
    lab = replace(lab, limits=replace(lab.limits, attempt_time=1.0))
    plan = plan_for(robot, tmp_path, OraclePolicy(robot), lab=lab)
    with pytest.raises(PeerTimeout, match="an attempt took more than 1 s"):
        run_insertions(plan)
    recorded = events(plan.session)
    assert ("state", {"state": "approach"}) in recorded
    assert ("state", {"state": "descend"}) not in recorded, "the approach takes longer than 1 s"
    assert "more than 1 s" in dict(recorded)["stopped"]["reason"]
    part = robot.cell.truth()["part"]
    assert part["phase"] == "gripped" and part["largest_push"] < 1e-4
