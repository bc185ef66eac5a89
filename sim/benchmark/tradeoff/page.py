"""The table of presets in docs/guide/presets.md: rows from measurements, and their replacement in the page."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from gelflow.sim.benchmark.tradeoff.preset_bounds import SCENE_DEFAULT, Bounds
from gelflow.sim.benchmark.tradeoff.sweep import Tradeoff
from gelflow.sim.scene import load_scene, scene_names

BEGIN, END = "<!-- written by benchmarks/tradeoff.py -->", "<!-- end -->"


def preset_rows(tradeoff: Tradeoff, limits: Mapping[str, Bounds]) -> list[str]:
    """Markdown rows of the scene's presets and of its default settings."""
    speeds = {name: measurement.speed for measurement in tradeoff.measurements for name in measurement.presets}
    speeds[SCENE_DEFAULT] = next(m.speed for m in tradeoff.measurements if m.setting.group == SCENE_DEFAULT)
    return [_row(tradeoff.scene, name, limit, speeds[name]) for name, limit in limits.items()]


def _row(scene: str, name: str, limit: Bounds, speed: float) -> str:
    """One row; units as in the heading of the table."""
    loaded, bound = load_scene(scene, preset=None if name == SCENE_DEFAULT else name), limit.bound
    settings = f"{loaded.integrator.upper()}, {1e3 * loaded.step:g} ms, {loaded.tolerance:.0e}".replace("e-0", "e-")
    figures = (1e3 * bound.position, 1e3 * bound.rotation, 100 * bound.markers, bound.flow)
    cells = [scene, name, settings, f"{speed:.0f}", *(f"{x:.3g}" for x in figures), f"{bound.cosine:.4f}"]
    return f"| {' | '.join([*cells, f'{100 * bound.gradient:.3g}'])} |"


def update_page(page: Path, rows: Mapping[str, Sequence[str]]) -> None:
    """Replace the rows of the given scenes (scene → rows) in the table of the page."""
    text = page.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    inside, after = rest.split(END)
    lines = inside.strip().splitlines()
    present = {name: [line for line in lines[2:] if line.startswith(f"| {name} |")] for name in scene_names()}
    body = [line for name in scene_names() for line in rows.get(name, present[name])]
    page.write_text(f"{before}{BEGIN}\n{chr(10).join([*lines[:2], *body])}\n{END}{after}", encoding="utf-8")
