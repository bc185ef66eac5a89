"""Reproduction of the paper's experiments, in tiny settings: rows, continuation after a kill, curves, the command."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gelflow.cli.commands.training.reproduce import TASKS
from gelflow.cli.main import main
from gelflow.errors import UsageError
from gelflow.policies.recipes import recipe_for
from gelflow.policies.reproduction import picture
from gelflow.policies.reproduction.record import over_seeds, reproduce
from gelflow.policies.reproduction.trials import EVALUATION, Effort
from gelflow.policies.reproduction.variants import (
    REPRODUCTIONS,
    Published,
    Reproduction,
    Variant,
    insertion_of,
    reproduction_for,
)
from gelflow.task import INSERTION

TINY = Effort((0, 1), shorter=10**9, max_episodes=4, envs=4)
PLAN = Reproduction(
    "grasp",
    (
        Variant("11 blocks", paper=Published(0.985, 0.018, 2.1)),
        Variant("7 blocks", evaluation={"blocks": 7}, trained_as="11 blocks", paper=Published(0.933)),
    ),
)
COMMAND = ["gelflow", "reproduce", "grasp"]


def without_times(value: Any) -> Any:
    """A record without what a repetition changes."""
    if isinstance(value, dict):
        return {key: without_times(item) for key, item in value.items() if key != "training_minutes"}
    return [without_times(item) for item in value] if isinstance(value, list) else value


class Killed(Exception):
    """Ends a reproduction as a kill would."""


@pytest.mark.slow
def test_a_killed_reproduction_continues_and_gives_the_same_record(tmp_path: Path) -> None:
    whole = reproduce(PLAN, tmp_path / "whole", effort=TINY, command=COMMAND)

    def kill(variant: str, seed: int, text: str, part: float) -> None:
        if (variant, seed, text) == ("7 blocks", 0, "evaluating"):
            raise Killed

    with pytest.raises(Killed):
        reproduce(PLAN, tmp_path / "killed", effort=TINY, command=COMMAND, report=kill)
    done: list[tuple[str, int, str]] = []
    again = reproduce(
        PLAN,
        tmp_path / "killed",
        effort=TINY,
        command=COMMAND,
        report=lambda variant, seed, text, part: done.append((variant, seed, text)),
    )
    assert done == [("7 blocks", 0, "evaluating"), ("7 blocks", 1, "evaluating")]
    assert without_times(again) == without_times(whole)
    first, second = again["variants"]
    assert first["ours"]["episodes"] == second["ours"]["episodes"] == 8 and len(first["ours"]["success_of_seeds"]) == 2
    assert first["oracle"]["success"] == 1 and "attempts" in first["ours"] and first["random"]["success"] < 1
    assert first["paper"] == {"success": 0.985, "spread": 0.018, "length": 2.1}
    assert {"command", "processor", "versions", "seeds"} <= set(again) and len(first["training_minutes"]) == 2
    picture.draw(again, tmp_path / "grasp.png")
    assert (tmp_path / "grasp.png").read_bytes().startswith(b"\x89PNG")


def test_a_folder_with_other_settings_or_a_damaged_evaluation_is_rejected(tmp_path: Path) -> None:
    single = Effort((0,), shorter=10**9, max_episodes=2, envs=2)
    plan = Reproduction("grasp", PLAN.variants[:1])
    reproduce(plan, tmp_path, effort=single, command=COMMAND)
    longer = Effort((0,), shorter=4, max_episodes=2, envs=2)
    with pytest.raises(UsageError, match=r"holds a finished run with other settings: .*run.steps 1 \(here 5120\)"):
        reproduce(plan, tmp_path, effort=longer, command=COMMAND)
    more = Effort((0,), shorter=10**9, max_episodes=3, envs=2)
    assert reproduce(plan, tmp_path, effort=more, command=COMMAND)["variants"][0]["ours"]["episodes"] == 3
    next(tmp_path.rglob(EVALUATION)).write_text("{")
    with pytest.raises(UsageError, match="is damaged"):
        reproduce(plan, tmp_path, effort=more, command=COMMAND)


def test_the_insertion_is_trained_by_imitation(tmp_path: Path) -> None:
    plan = Reproduction("insertion", reproduction_for("insertion").variants[:1])
    effort = Effort((0,), shorter=10**9, max_episodes=2, envs=2)
    row = reproduce(plan, tmp_path, effort=effort, command=COMMAND)["variants"][0]
    assert row["oracle"]["corrections"] == 1 and row["curves"]["validation"]["x"] == [512.0]
    assert (insertion_of(plan.variants[0]).corrected_axes == [0, 0, 1]).all()
    deeper = insertion_of(reproduction_for("insertion").variant("full randomization, deeper descents"))
    assert deeper == dataclasses.replace(INSERTION, descent=4.1e-3, frame_depths=(4.1e-3,))
    assert reproduce(plan, tmp_path, effort=effort, command=COMMAND)["variants"][0] == row


def test_the_tables_of_variants_are_complete() -> None:
    assert tuple(REPRODUCTIONS) == ("grasp", "cap", "pushing", "insertion") and set(REPRODUCTIONS) == set(TASKS)
    for plan in REPRODUCTIONS.values():
        names = [variant.name for variant in plan.variants]
        assert len(set(names)) == len(names)
        for variant in plan.variants:
            assert variant.trained_as is None or plan.variant(variant.trained_as).trained_as is None
            if plan.task != "insertion":
                recipe_for(plan.task, variant.recipe)
    with pytest.raises(UsageError, match="no reproduction of 'rolling'; there are grasp, cap"):
        reproduction_for("rolling")


def test_rows_pool_the_episodes_and_spread_over_the_seeds() -> None:
    rows = [
        {"episodes": 10, "successes": n, "success": n / 10, "steps": steps, "reward": -1.0, "metrics": {"force [N]": n}}
        for n, steps in ((9, 4.0), (10, 6.0), (0, None))
    ]
    pooled = over_seeds(rows)
    assert pooled["episodes"] == 30 and pooled["success"] == pytest.approx(19 / 30) and pooled["steps"] == 5
    assert pooled["success_deviation"] == pytest.approx(np.std([0.9, 1.0, 0.0], ddof=1))
    assert over_seeds(rows[:1])["success_deviation"] is None
    assert pooled["metrics"] == {"force [N]": pytest.approx(19 / 3)}


def test_the_command_writes_rows_and_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(REPRODUCTIONS, "grasp", Reproduction("grasp", PLAN.variants[:1]))
    arguments = ["reproduce", "grasp", "--quick", "--seed", "5", "--out", str(tmp_path)]
    assert main([*arguments, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["records"][0]["command"] == [
        "gelflow",
        "reproduce",
        "grasp",
        "--seeds",
        "1",
        "--seed",
        "5",
        "--quick",
    ]
    assert printed["records"][0]["seeds"] == [5] and printed["records"][0]["quick"]
    assert [Path(name).name for name in printed["files"]] == ["reproduce_grasp.json", "reproduce_grasp.png"]
    assert json.loads((tmp_path / "reproduce_grasp.json").read_text()) == printed["records"][0]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert all(text in out for text in ("98.5", "(2.10)", "oracle")) and max(map(len, out.splitlines()[:-2])) <= 100
    assert main(["reproduce", "grasp", "--seeds", "0"]) == 2
    assert "--seeds must be at least 1" in capsys.readouterr().err
