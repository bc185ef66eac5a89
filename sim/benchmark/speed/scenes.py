"""Speed of the included scenes on their reference motions, with both friction laws."""

from gelflow.measurement.timing import BenchmarkOptions, Report, load_note, time_interleaved
from gelflow.sim.benchmark.speed.rolling import rolling_scene
from gelflow.sim.benchmark.speed.timed_run import TIMED, check_accuracy, motion_run, simulator
from gelflow.sim.scene import FRICTION_LAWS, load_scene
from gelflow.sim.validation.reference_motions import SCENES

SIDE = 50  # markers along each side of the rolling pad

# Published simulator, fastest build on one core of a recent server, viscous law [steps/s].
PAPER = {"pushing": 5400.0, "grasp": 1000.0, "insertion": 1940.0, "dclaw": 840.0}


def measure_scenes(options: BenchmarkOptions, *, steps: int | None = None) -> Report:
    """Time the reference motion of each scene, or its first `steps`."""
    cases = [(name, law) for name in SCENES for law in FRICTION_LAWS]
    workloads, checks = [], []
    for name, law in cases:
        scene = rolling_scene(SIDE, law) if name == "rolling" else load_scene(name, friction=law)
        run, sim = motion_run(scene, steps=steps), simulator(scene.model_spec, tolerance=TIMED[law])
        checks.append(check_accuracy(run, sim, scene.model_spec))
        workloads.append(run.workload(sim))
    options.progress.begin("scenes", len(workloads) * (options.repeats + 1))
    timings = time_interleaved(workloads, options)
    rows, results, violations = [], [], []
    for (name, law), times, accuracy in zip(cases, timings, checks, strict=True):
        published = PAPER.get(name) if law == "viscous" else None
        ratio = times.rate / published if published else None
        rows.append(
            (
                *(name, law, f"{times.rate:.0f}", times.spread, f"{times.median * 1e6:.1f}"),
                *(
                    f"{accuracy.iterations:.2f}",
                    f"{published:.0f}" if published else "",
                    f"{ratio:.1f}" if ratio else "",
                ),
            )
        )
        results.append(
            {
                "scene": name,
                "friction": law,
                "gelflow": times.to_dict(),
                "paper": published,
                "times_the_paper": ratio,
                "check": accuracy.to_dict(),
            }
        )
        violations += accuracy.violations(f"{name}, {law}")
    return Report(
        name="scenes",
        title="Scenes: steps per second of one thread",
        columns=("scene", "friction", "steps/s", "±", "µs", "Newton", "paper", "× paper"),
        rows=rows,
        note="Steps of 5 ms; controls change and tactile forces are evaluated every 5. ±: half the interquartile range."
        " µs: per step, tactile forces included. Newton: iterations per step, with tolerance "
        f"{TIMED['viscous']:g} (viscous) or {TIMED['elastic']:g}. paper: published simulator, fastest build on a "
        "comparable core, viscous friction." + load_note(timings),
        results=results,
        violations=violations,
    )
