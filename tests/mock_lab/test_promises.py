"""`gelflow soak --promises` and `--egm`: results, repetitions after a stop by load, and statistics of EGM cycles."""

import math
from pathlib import Path

import pytest

from gelflow.cli.main import main
from gelflow.errors import PeerError
from gelflow.mock_lab.promises.endurance import CycleStatistics
from gelflow.mock_lab.promises.outcome import Outcome, Promise, conditions, measure
from gelflow.mock_lab.promises.report import remarks, to_json
from gelflow.mock_lab.promises.rig import FalseStop, far_seed, near_seed
from gelflow.real.egm.cycle_log import EgmCycle
from gelflow.real.egm.reference_generator import EgmFlag

POSE = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
CYCLE = EgmCycle(0.0, None, POSE, POSE, (0.0,) * 6, EgmFlag(0), 0, 0.0, 0.0)


def promise(scenario: object, bound: float = 20.0) -> Promise:
    return Promise("name", "text", "time", bound, "ms", scenario, ("tests/a.py::test_a",))  # type: ignore[arg-type]


def test_a_promise_holds_within_its_bound_and_without_a_broken_condition() -> None:
    assert measure(promise(lambda folder: Outcome(20.0))).held
    assert not measure(promise(lambda folder: Outcome(20.1))).held
    assert not measure(promise(lambda folder: Outcome(math.nan))).held
    row = measure(promise(lambda folder: Outcome(1.0, conditions(part_is_held=False, arm_rests=True))))
    assert not row.held and row.outcome.broken == ("part is held",)
    assert remarks([row]) == ["name: not so: part is held"]


def test_a_scenario_that_the_load_ended_is_repeated_and_the_row_says_so() -> None:
    folders: list[Path] = []

    def scenario(folder: Path) -> Outcome:
        assert folder.is_dir() and not list(folder.iterdir())
        folders.append(folder)
        if len(folders) < 3:
            raise FalseStop("the arm's pose is 30 ms old")
        return Outcome(5.0)

    row = measure(promise(scenario))
    assert row.held and len(folders) == 3
    assert "2 earlier stops by the load of this computer: the arm's pose is 30 ms old" in row.outcome.note
    assert not any(folder.exists() for folder in folders)


def test_a_scenario_that_is_never_reached_or_fails_is_not_held() -> None:
    def false_stop(folder: Path) -> Outcome:
        raise FalseStop("busy")

    def failure(folder: Path) -> Outcome:
        raise PeerError("the run did not end within 60 s")

    assert not measure(promise(false_stop)).held
    row = measure(promise(failure))
    assert not row.held and row.outcome.broken == ("the run did not end within 60 s",)
    assert to_json([row])["promises"][0]["held"] is False


def test_missed_cycles_and_jitter_are_counted() -> None:
    statistics = CycleStatistics()
    stamps = [0.0, 0.004, 0.0085, 0.0165, 0.0166]
    sequences = [10, 11, 12, 14, 15]
    cycles = [replace_cycle(CYCLE, stamp, sequence) for stamp, sequence in zip(stamps, sequences, strict=True)]
    cycles[3] = cycles[3]._replace(flags=EgmFlag.UNANSWERED, answered=math.nan)
    statistics.add(cycles[:2])
    statistics.add(cycles[2:])
    summary = statistics.summary()
    assert (summary["cycles"], summary["lost"], summary["unanswered"]) == (4, 1, 1)
    assert summary["missed"] == pytest.approx(2 / 6)
    assert statistics.missed == [(0.0085, 0.0165, 1), (pytest.approx(0.0125), 0.0165, 1)]
    assert summary["jitter_max_ms"] == pytest.approx(4.0)
    assert summary["latency_max_ms"] == pytest.approx(0.2)


def test_a_stop_before_the_first_message_counts_too() -> None:
    statistics = CycleStatistics()
    statistics.stop(0.02)
    statistics.stop(0.02)
    assert statistics.lost == 10
    assert statistics.missed == [(math.inf, math.inf, 5)] * 2


def replace_cycle(cycle: EgmCycle, stamp: float, sequence: int) -> EgmCycle:
    return cycle._replace(stamp=stamp, sequence=sequence, answered=stamp + 0.0002)


def test_seeds_of_the_scenarios_differ() -> None:
    assert near_seed() != far_seed()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--promises", "--only", "contct"], "there is no promise 'contct'"),
        (["--only", "contact"], "--only is the seed of a plan"),
        (["--egm", "0"], "--egm must be above 0"),
        (["--promises", "--plans", "5"], "--plans is for random plans, and --promises runs none"),
        (["--promises", "--preset", "fast"], "--preset is for random plans, and --promises runs none"),
        (["--egm", "1", "--factor", "4"], "--factor is for random plans, and --egm runs none"),
        (["--egm", "1", "--only", "contact"], "--only names a plan or a promise, and --egm runs none"),
        (["--egm", "1", "--promises"], "--promises and --egm are different tests"),
    ],
)
def test_invalid_options_give_a_one_line_error(
    options: list[str], text: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["soak", *options, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert text in error and error.count("\n") == 1
