"""The error bounds in docs/guide/presets.md hold for other samples of the physics."""

from pathlib import Path

import pytest

from gelflow.sim.benchmark.tradeoff.preset_bounds import SCENE_DEFAULT, preset_errors
from gelflow.sim.benchmark.tradeoff.run import Errors
from gelflow.sim.scene import PRESET_NAMES, load_scene, scene_names

PAGE = Path(__file__).parents[3] / "docs" / "guide" / "presets.md"
SEEDS = (1001, 1002, 1003)  # the page's draws have seeds from 0 on
HALVINGS = 8


def promised() -> dict[tuple[str, str], tuple[str, Errors]]:
    """(scene, preset) → settings as text, and the bounds."""
    found = {}
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 10 and cells[0] in scene_names():
            mm, mrad, markers, flow, cosine, gradient = map(float, cells[4:])
            errors = Errors(1e-3 * mm, 1e-3 * mrad, 1e-2 * markers, flow, cosine, 1e-2 * gradient)
            found[cells[0], cells[1]] = cells[2], errors
    return found


def test_page_lists_every_preset_with_its_settings() -> None:
    found = promised()
    assert set(found) == {(scene, name) for scene in scene_names() for name in (*PRESET_NAMES, SCENE_DEFAULT)}
    for (scene, name), (how, _) in found.items():
        way = load_scene(scene, preset=None if name == SCENE_DEFAULT else name)
        integrator, step, tolerance = how.split(", ")
        assert integrator.lower() == way.integrator
        assert float(step.removesuffix(" ms")) == pytest.approx(1e3 * way.step)
        assert float(tolerance) == way.tolerance


@pytest.mark.parametrize("scene", scene_names())
def test_errors_stay_within_the_bounds(scene: str) -> None:
    table = promised()
    for name, worst in preset_errors(scene, SEEDS, halvings=HALVINGS).items():
        _, bound = table[scene, name]
        for figure, value in vars(worst).items():
            limit = getattr(bound, figure)
            good = value >= limit if figure == "cosine" else value <= limit
            assert good, f"{scene}, {name}: {figure} {value:.3g}, promised {limit:.3g}"
