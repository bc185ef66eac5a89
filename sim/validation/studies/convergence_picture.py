"""Picture of the convergence study: errors over the step on whole scenes, and errors over cost of some schemes."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from gelflow.sim.validation.studies.convergence import Convergence
from gelflow.sim.validation.studies.schemes import Scheme

COLORS = {"viscous": "tab:blue", "elastic": "tab:orange"}


def draw(
    found: Sequence[Convergence], ball: Sequence[Scheme], scenes: Mapping[str, Sequence[Scheme]], path: Path
) -> None:
    """Draw convergence of the scenes, and errors over cost of the schemes on the ball and on scenes. Writes `path`."""
    from matplotlib.figure import Figure  # deferred: slow to import

    names = list(dict.fromkeys(r.scene for r in found))
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    axes = figure.subplots(2, 3)
    for axis, name in zip(axes[0], names, strict=True):
        for r in (r for r in found if r.scene == name):
            style = {"bdf1": "o--", "bdf2": "s-"}[r.integrator]
            for quantity, alpha in (("q", 1.0), ("tactile", 0.35)):
                label = f"{r.integrator.upper()}, {r.law}, {quantity}"
                axis.loglog(r.steps, r.errors(quantity), style, color=COLORS[r.law], alpha=alpha, ms=3, label=label)
        steps = max((r.steps for r in found if r.scene == name), key=len)
        axis.loglog(steps, [s / steps[0] for s in steps], "k:", lw=0.8, label="slope 1")
        axis.set(title=name, xlabel="time step [s]", ylabel="mean relative error")
        axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=6)
    panels = {"ball on a plane": ball, **scenes}
    for axis, (title, schemes) in zip(axes[1], panels.items(), strict=False):
        for scheme in schemes:
            axis.loglog(scheme.solves, scheme.errors, "o-", ms=3, label=scheme.name)
        axis.set(title=title, xlabel="Newton iterations", ylabel="relative error at the end")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
