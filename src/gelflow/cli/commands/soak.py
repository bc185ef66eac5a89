"""`gelflow soak`: the runner with the mock robot: random fault plans, its promises one by one, endurance of EGM."""

import argparse
import statistics
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from gelflow.cli.exit_codes import NEGATIVE_RESULT, SUCCESS
from gelflow.cli.options import add_json, add_out, add_preset, add_seed, check_at_least
from gelflow.cli.output import Output, progress_bar
from gelflow.errors import PeerError, UsageError
from gelflow.toml_tables import suggestion

if TYPE_CHECKING:
    from gelflow.mock_lab.soak.case import SoakCase
    from gelflow.mock_lab.soak.ledger import Ledger

_FAILED_STARTS = 3  # of the mock robot, in sequence, after which the soak test ends
# Options of random plans only, and their defaults.
_PLANS_ONLY: dict[str, Any] = {"plans": 20, "factor": 2.0, "jitter": 0.1, "jobs": 1, "seed": 0, "preset": None}


def configure(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.set_defaults(**_PLANS_ONLY)
    parser.add_argument("--plans", type=int, metavar="N", help="number of plans (default %(default)s)")
    parser.add_argument("--promises", action="store_true", help="measure bounds on the runner's reactions instead")
    parser.add_argument("--egm", type=float, metavar="MINUTES", help="run EGM, cameras, tracking and recording instead")
    parser.add_argument("--only", metavar="WHICH", help="the plan of this seed alone, or this promise alone")
    parser.add_argument("--factor", type=float, metavar="X", help="robot time over wall time (default 2)")
    parser.add_argument(
        "--jitter",
        type=float,
        metavar="S",
        help="added to a robot's time limits, for a computer with load (default %(default)s s)",
    )
    parser.add_argument("--jobs", type=int, metavar="N", help="plans at the same time (default 1)")
    add_seed(parser)
    add_preset(parser)
    add_out(parser, "folder of the results, continued if it exists", default=Path("out/soak"), folder=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Run what the options name.

    Negative: a rule was violated, a promise or a bound did not hold, or a plan did not run.
    """
    _check_options(args)
    if args.promises:
        return _run_promises(args)
    if args.egm is not None:
        return _run_endurance(args)
    return _run_plans(args)


def _check_options(args: argparse.Namespace) -> None:
    """Raise UsageError for an option without effect."""
    if args.promises and args.egm is not None:
        raise UsageError("--promises and --egm are different tests; name one of them")
    other = "--promises" if args.promises else "--egm" if args.egm is not None else ""
    for name, default in _PLANS_ONLY.items():
        if other and getattr(args, name) != default:
            raise UsageError(f"--{name} is for random plans, and {other} runs none")
    if args.egm is not None and args.only is not None:
        raise UsageError("--only names a plan or a promise, and --egm runs none")


def _run_promises(args: argparse.Namespace) -> int:
    """Measure the promises one after the other."""
    from gelflow.mock_lab.promises.outcome import Row, measure
    from gelflow.mock_lab.promises.report import remarks, table, to_json, write_json
    from gelflow.mock_lab.promises.table import PROMISES
    from gelflow.policies.training.folder import create_folder

    output = Output(args.json)
    if args.only is not None and args.only not in PROMISES:
        raise UsageError(f"there is no promise {args.only!r}; {suggestion(args.only, PROMISES)}")
    create_folder(args.out)
    chosen = [PROMISES[args.only]] if args.only is not None else list(PROMISES.values())
    rows: list[Row] = []
    with progress_bar(count=True) as progress:
        bar = progress.add_task("promises", total=len(chosen))
        for promise in chosen:
            rows.append(measure(promise))
            progress.advance(bar)
    output.console.print(table(rows))
    for line in remarks(rows):
        output.text(line)
    result = to_json(rows)
    output.text(f"{sum(row.held for row in rows)} of {len(rows)} promises held; load {result['load']}")
    output.result(result)
    write_json(args.out / ("promises.json" if args.only is None else f"promises-{args.only}.json"), result)
    return SUCCESS if all(row.held for row in rows) else NEGATIVE_RESULT


def _run_endurance(args: argparse.Namespace) -> int:
    """Run EGM with cameras, tracking and recording for some minutes."""
    from gelflow.mock_lab.promises.endurance import BOUND, measure_endurance
    from gelflow.mock_lab.promises.report import write_json
    from gelflow.policies.training.folder import create_folder

    if not 0 < args.egm <= 1440:
        raise UsageError(f"--egm must be above 0 and at most 1440 minutes, got {args.egm:g}")
    create_folder(args.out)
    output = Output(args.json)
    with progress_bar() as progress:
        bar = progress.add_task("EGM", total=60 * args.egm)
        result = measure_endurance(60 * args.egm, lambda elapsed: progress.update(bar, completed=elapsed))
    for line in result.lines():
        output.text(line)
    output.result(result.to_json())
    write_json(args.out / "egm.json", result.to_json())
    return SUCCESS if result.missed <= BOUND and not result.stops else NEGATIVE_RESULT


def _run_plans(args: argparse.Namespace) -> int:
    """Run the plans that the folder does not contain yet, then print all counts."""
    from gelflow.mock_lab.soak.case import SoakCase
    from gelflow.mock_lab.soak.ledger import Ledger
    from gelflow.sim.scene import load_scene

    check_at_least(args, plans=1, seed=0, jobs=1, jitter=0, factor=1)
    load_scene("insertion", preset=args.preset)  # raises for an unknown preset
    only = None if args.only is None else _seed(args.only)
    output = Output(args.json)
    ledger = Ledger(args.out / "soak.jsonl", factor=args.factor, jitter=args.jitter, preset=args.preset)
    seeds = [only] if only is not None else range(args.seed, args.seed + args.plans)
    left = [seed for seed in seeds if only is not None or seed not in ledger.rows]
    if len(left) < len(seeds):
        output.text(f"{len(seeds) - len(left)} of {len(seeds)} plans are in {args.out} already.")
    cases = [SoakCase.of(seed, factor=args.factor, jitter=args.jitter, preset=args.preset) for seed in left]
    not_run = _run_all(cases, ledger, output, args)
    if only is not None:
        if not_run:
            raise PeerError(f"plan {only} did not run: {not_run[only]}")
        output.result({"rows": [ledger.rows[only]]})
        return NEGATIVE_RESULT if ledger.rows[only]["violations"] else SUCCESS
    _show(output, ledger)
    if not_run:
        output.text(f"not run: {' '.join(map(str, not_run))}; the same command runs them")
    result = {"plans": len(ledger.rows), "failing": ledger.failing(), "not_run": list(not_run)}
    output.result(result | ledger.counts())
    return NEGATIVE_RESULT if ledger.failing() or not_run else SUCCESS


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise UsageError(f"--only is the seed of a plan, or with --promises the name of one; got {text!r}")
    return int(text)


def _run_all(cases: "list[SoakCase]", ledger: "Ledger", output: Output, args: argparse.Namespace) -> dict[int, str]:
    """Run the cases, `--jobs` at a time; returns the seeds of those that did not run, with the reason.

    Raises PeerError when the mock robot repeatedly fails to start.
    """
    from gelflow.mock_lab.soak.case import try_case

    failed = 0
    not_run: dict[int, str] = {}
    with progress_bar(count=True) as progress, ThreadPoolExecutor(args.jobs) as pool:
        bar = progress.add_task("plans", total=len(cases))
        waiting = list(cases)
        running: dict[Future[dict[str, Any] | str], SoakCase] = {}
        while waiting or running:
            while waiting and len(running) < args.jobs:
                case = waiting.pop(0)
                running[pool.submit(try_case, case, args.out / "failing" / str(case.seed))] = case
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                case, row = running.pop(done), done.result()
                failed = failed + 1 if isinstance(row, str) else 0
                if isinstance(row, str):
                    not_run[case.seed] = row
                    output.text(f"plan {case.seed} did not run: {row}")
                    if failed >= _FAILED_STARTS:
                        raise PeerError(f"{failed} plans in sequence did not run: {row}")
                else:
                    ledger.add(case.seed, row)
                    output.text(_line(case.seed, row))
                progress.advance(bar)
    return not_run


def _line(seed: int, row: dict[str, Any]) -> str:
    if not row["truth"]:
        return f"{seed:6d}  {row['outcome']}: {row['message']}"
    broken = f"  VIOLATED: {', '.join(row['violations'])}" if row["violations"] else ""
    truth = "in the hole" if row["truth"].get("inserted") else "not in the hole"
    pushed = 1e3 * row["truth"].get("largest_push", 0.0)
    return f"{seed:6d}  {row['wall']:5.1f} s  {row['outcome']} ({truth}, pushed {pushed:.2f} mm)  {row['plan']}{broken}"


def _show(output: Output, ledger: "Ledger") -> None:
    """Tables of the outcomes, of the kinds of faults, and of the rules."""
    from gelflow.mock_lab.soak.rules import RULES

    counts, rows = ledger.counts(), list(ledger.rows.values())
    table = Table(title=f"Soak test: {len(rows)} plans")
    for name in ("outcome", "plans"):
        table.add_column(name, justify="right" if name == "plans" else "left")
    for outcome, count in sorted(counts["outcomes"].items(), key=lambda item: -item[1]):
        table.add_row(outcome, str(count))
    table.add_section()
    for rule in RULES:
        count = counts["violations"].get(rule, 0)
        table.add_row(f"violated: {rule}", str(count), style="red" if count else "green")
    output.console.print(table)
    kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(counts["kinds"].items()))
    output.text(f"kinds of faults: {kinds}")
    pushes = [1e3 * row["truth"].get("largest_push", 0.0) for row in rows]
    if pushes:
        output.text(f"largest push: {max(pushes):.2f} mm, median {statistics.median(pushes):.2f} mm")
    if ledger.failing():
        seeds = " ".join(map(str, ledger.failing()))
        output.text(f"failing seeds: {seeds}; run one again with the same options and --only SEED")
