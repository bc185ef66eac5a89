"""Fault plans are read strictly, written back equal, and drawn at random reproducibly."""

import math
from collections import Counter
from pathlib import Path

import pytest

from gelflow.errors import UsageError
from gelflow.hardware_mocks.faults.injector import event_occurred
from gelflow.hardware_mocks.faults.plan import DEVICES, EVENTS, KINDS, Fault, FaultPlan
from gelflow.hardware_mocks.faults.plan_file import load_fault_plan, plan_from_tables, plan_to_tables
from gelflow.hardware_mocks.faults.random_plan import random_plan
from gelflow.hardware_mocks.simulated_cell.insertion_progress import PHASES, InsertionMonitor, InsertionProgress
from gelflow.task import INSERTION


def test_plan_file_gives_the_faults_that_it_names(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(
        'format = 1\n[[fault]]\ndevice = "cameras"\nkind = "freeze"\nevent = "lowering"\nbelow = 0.015\nloop = 3\n'
        '[[fault]]\ndevice = "arm"\nkind = "drop"\nat = 12.5\nduration = 0.3\nshare = 0.7\ndirection = "out"\n'
        '[[fault]]\ndevice = "gripper"\nkind = "corrupt"\nrandom = { seed = 4, rate = 0.2 }\nduration = 1\n'
        "[random]\nseed = 7\n"
    )
    plan = load_fault_plan(path)
    assert plan.faults[:3] == (
        Fault("cameras", "freeze", event="lowering", below=0.015, parameters={"loop": 3.0}),
        Fault("arm", "drop", at=12.5, duration=0.3, direction="out", parameters={"share": 0.7}),
        Fault("gripper", "corrupt", rate=0.2, seed=4, duration=1.0),
    )
    assert plan.faults[3:] == random_plan(7).faults
    assert plan.faults[0].values == {"loop": 3}
    assert plan.faults[1].values == {"share": 0.7, "seed": 0}
    assert str(plan.faults[1]) == "arm out: drop at 12.5 s for 0.3 s, share 0.7"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "drop"\nat = 1', "device is missing"),
        ('device = "camera"\nkind = "drop"\nat = 1', "device is 'camera'; did you mean 'cameras'?"),
        ('device = "arm"\nkind = "dropp"\nat = 1', "kind is 'dropp'; did you mean 'drop'?"),
        ('device = "arm"\nkind = "blacken"\nat = 1', "blacken exists for left_camera, right_camera, cameras"),
        ('device = "arm"\nkind = "drop"', "needs exactly one of at, event and random"),
        ('device = "arm"\nkind = "drop"\nat = 1\nevent = "gripped"', "needs exactly one of at, event and random"),
        ('device = "arm"\nkind = "drop"\nevent = "grip"', "did you mean 'gripped'?"),
        ('device = "arm"\nkind = "drop"\nat = -1', "at and after at least 0"),
        ('device = "arm"\nkind = "drop"\nat = 1\nduration = 0', "duration must be above 0"),
        ('device = "arm"\nkind = "drop"\nat = 1\nshare = 2', "share of kind drop must be 0 to 1"),
        ('device = "arm"\nkind = "drop"\nat = 1\nzoom = 2', "no parameter 'zoom'; its parameters: share"),
        ('device = "arm"\nkind = "freeze"\nat = 1\nloop = 2', "no parameter 'loop'; its parameters: none"),
        ('device = "cameras"\nkind = "drop"\nat = 1\ndirection = "in"', "direction belongs to the messages of arm"),
        ('device = "arm"\nkind = "drop"\nevent = "gripped"\nbelow = 1', "below belongs to the events descent"),
        ('device = "arm"\nkind = "drop"\nat = 1\nattempt = 2', "attempt belongs to the events descent, lowering"),
        ('device = "arm"\nkind = "drop"\nevent = "released"\nattempt = 2', "attempt belongs to the events descent"),
        ('device = "arm"\nkind = "drop"\nat = 1\nafter = 2', "after belongs to events"),
        ('device = "arm"\nkind = "drop"\nrandom = { rate = 1 }\nafter = 2', "after belongs to events"),
        ('device = "arm"\nkind = "drop"\nat = 1\nfor = 2', "unknown key 'for'; did you mean 'factor'"),
        ('device = "arm"\nkind = "drop"\nrandom = { rate = 0 }', "rate must be a finite number"),
    ],
)
def test_a_wrong_fault_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(f"[[fault]]\n{text}\n")
    with pytest.raises(UsageError) as error:
        load_fault_plan(path)
    assert message in str(error.value) and f"{path}, fault 1" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text", ["format = 2", "fault = 3", "faults = []", "[random]\nrate = 1", "[random]\nseed = -1"]
)
def test_a_wrong_plan_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"plan\.toml"):
        load_fault_plan(path)


def test_random_plans_are_reproducible_and_reach_every_kind_device_and_event() -> None:
    plans = [random_plan(seed) for seed in range(600)]
    assert plans == [random_plan(seed) for seed in range(600)]
    assert len(set(map(str, plans))) > 590
    faults = [fault for plan in plans for fault in plan.faults]
    assert Counter(fault.kind for fault in faults).keys() == KINDS.keys()
    assert {fault.device for fault in faults} == set(DEVICES)
    assert {fault.event for fault in faults} == {"", *EVENTS}
    assert 0.2 < sum(len(plan.faults) == 2 for plan in plans) / len(plans) < 0.5


def test_a_plan_that_is_written_as_tables_is_read_back_equal() -> None:
    for seed in range(200):
        plan = random_plan(seed)
        assert plan_from_tables(plan_to_tables(plan), "again") == plan
    assert plan_from_tables(plan_to_tables(FaultPlan()), "again") == FaultPlan()


def test_events_come_in_the_order_of_an_insertion() -> None:
    monitor = InsertionMonitor(INSERTION)
    seen: list[str] = []
    waiting = {event: Fault("arm", "stall", event=event) for event in EVENTS}
    waiting["second descent"] = Fault("arm", "stall", event="descent", attempt=2)
    waiting["deep"] = Fault("arm", "stall", event="lowering", below=0.010)

    def reach(phase: str, *heights: float) -> None:
        for height in heights:
            monitor.update(0.0, phase, height)
            for name, fault in list(waiting.items()):
                if event_occurred(fault, monitor.progress, INSERTION):
                    seen.append(name)
                    del waiting[name]

    reach("presented", 0.032)
    assert not seen
    reach("gripped", 0.032)
    assert seen == ["gripped"]
    reach("gripped", 0.030, 0.0255)
    assert seen[-1] == "approach"
    reach("gripped", 0.0252)
    assert seen[-2:] == ["descent", "attempt"]
    reach("gripped", 0.0244, 0.0255, 0.0253)
    assert seen[-1] == "second descent"
    reach("gripped", 0.0212)
    assert seen[-1] == "lowering"
    reach("gripped", 0.0099)
    assert seen[-1] == "deep"
    reach("released", 0.002)
    assert seen[-1] == "released" and not waiting
    monitor.update(0.0, "presented", 0.032)
    assert monitor.progress.attempts == 0


def test_progress_is_the_same_after_shared_memory() -> None:
    progress = InsertionProgress(1.0, 2.0, float(PHASES.index("gripped")), 0.03, 0.032, 2.0)
    assert len(progress.to_words()) == InsertionProgress.WORDS
    assert InsertionProgress.from_words(list(progress.to_words())) == progress
    assert math.isnan(InsertionProgress().started) and progress.approaching
