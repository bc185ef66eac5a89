"""Calibrates mock robots in random worlds from five insertions: through protocols, camera images and tracker.

    python -m benchmarks.training.mock_calibration --worlds 20

The worlds differ in gels, friction, hole, arm and crosstalk, drawn from a third of the lower limits to three times the
upper limits of the randomization; the calibration uses the recorded session only. The same command continues a run that
was killed.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks import script

from gelflow.errors import GelflowError
from gelflow.mock_lab.robot_process import mock_robot
from gelflow.policies.calibration.calibration import calibrate
from gelflow.policies.calibration.experiment.coverage import counted, coverage_table, outcome
from gelflow.policies.calibration.experiment.worlds import widened
from gelflow.policies.calibration.session_recordings import read_recordings
from gelflow.policies.checkpoint import default_checkpoint, load_policy
from gelflow.real.runner.lab_file import load_lab
from gelflow.real.runner.run_plan import RunPlan, run_insertions
from gelflow.sim.tasks.insertion_randomization import FULL_RANDOMIZATION, NOMINAL
from gelflow.task import INSERTION
from gelflow.toml_tables import toml_text

PARTS = 5
_LARGEST_FRICTION = 5.0  # of a mock robot


def main() -> int:
    parser = script.parser(__doc__ or "", out="mock_calibration.json", quick="one world", seed=0)
    parser.add_argument("--worlds", type=int, default=20, metavar="N", help="number of worlds (default 20)")
    parser.add_argument("--factor", type=float, default=5.0, metavar="X", help="robot time over wall time (default 5)")
    args = parser.parse_args()
    seeds = range(args.seed, args.seed + (1 if args.quick else args.worlds))
    result = counted(script.measure_each(args, seeds, lambda seed: calibrated(seed, args.factor), key="seed"))
    script.finish(args, script.header() | result, coverage_table(result))
    return 0


def calibrated(seed: int, factor: float) -> dict[str, Any]:
    """Truth, verdicts and held-out errors of one world, or why it has none."""
    world, truth = drawn(seed)
    begun = time.monotonic()
    try:
        with tempfile.TemporaryDirectory() as name:
            session = record(world, Path(name), seed, factor)
            recorded = time.monotonic()
            result = calibrate(read_recordings([session]), seed=seed, processes=2)
    except GelflowError as error:
        return {"seed": seed, "world": world, "refused": str(error)}
    return {
        "seed": seed,
        "world": world,
        "truth": truth,
        "intervals": {e.parameter.name: [e.low, e.high] for e in result.estimates},
        **outcome(result, truth),
        "minutes_recording": round((recorded - begun) / 60, 2),
        "minutes_fit": round((time.monotonic() - recorded) / 60, 2),
    }


def drawn(seed: int) -> tuple[dict[str, Any], dict[str, float]]:
    """A world file, and the true values of the parameters that a calibration fits."""
    rng = np.random.default_rng((seed, 0x30C))
    sampled = {name: float(v[0]) for name, v in widened(FULL_RANDOMIZATION).sample(rng, 1, friction="elastic").items()}
    nominal = {name: float(v[0]) for name, v in NOMINAL.sample(rng, 1, friction="elastic").items()}
    gel, hole = sampled["pad_kn"] / nominal["pad_kn"], sampled["hole_kn"] / nominal["hole_kn"]
    pads, arm = min(sampled["pad_mu"], _LARGEST_FRICTION), sampled["arm_stiffness"]
    rim, crosstalk = min(sampled["hole_mu"], _LARGEST_FRICTION), sampled["crosstalk"]
    world = {
        "gels": {"left": gel, "right": gel},
        "friction": {"pads": pads, "hole": rim},
        "hole": {"stiffness": hole},
        "arm": {"stiffness": arm, "yaw_stiffness": 0.05 * arm},  # the ratio of the randomization [m²]
        "sensor": {"crosstalk": crosstalk},
    }
    truth = {name: nominal[name] * gel for name in ("pad_kn", "pad_ks", "marker_kn", "marker_ks")}
    truth |= {"pad_mu": pads, "marker_mu": pads, "hole_kn": sampled["hole_kn"], "hole_mu": rim, "arm_stiffness": arm}
    truth |= {"gain_left": 1 / gel, "gain_right": 1 / gel, "gain_ratio": 1.0, "crosstalk": crosstalk}
    return world, truth | {"turn_left": 0.0, "turn_right": 0.0}


def record(world: dict[str, Any], folder: Path, seed: int, factor: float) -> Path:
    """The session of five insertions by a mock robot in a world."""
    file, session, checkpoint = folder / "world.toml", folder / "session.mcap", default_checkpoint()
    file.write_text(toml_text({"format": 1, **world}), encoding="utf-8")
    with mock_robot(factor=factor, seed=seed, world=file) as (lab_file, _):
        policy = load_policy(checkpoint, task=INSERTION)
        plan = RunPlan(load_lab(lab_file), policy, INSERTION, session, checkpoint=checkpoint, insertions=PARTS)
        run_insertions(plan)
    return session


if __name__ == "__main__":
    raise SystemExit(script.run(main))
