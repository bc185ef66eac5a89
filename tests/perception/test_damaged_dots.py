"""Damaged and joined dots: their centres, and the masks of the compiled tracker."""

from typing import Any

import numpy as np
import pytest

from gelflow.perception._tracker import MASK_CELLS, PROFILE_STEPS, Tracker
from gelflow.perception.dot_model import DotModel, fit_dot_model
from gelflow.perception.grid_detection.grid import find_grid
from gelflow.perception.grid_detection.grid_part import GridRequest
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.appearance import make_appearance

MARKERS = 130


def errors_at_rest(preset: str, seed: int, **changed: float) -> tuple[np.ndarray, np.ndarray, DotModel]:
    """Position errors [px] of the dots of a first image, which of them are damaged or joined, and the dot model."""
    renderer = AccurateGelRenderer(make_appearance(preset, seed=seed, **changed))  # type: ignore[arg-type]
    frame, defects = renderer.render(np.zeros((MARKERS, 2))), renderer._print
    grid = find_grid(frame.image, GridRequest(rows=10, cols=13))
    _, model = fit_dot_model(frame.image, grid)
    damaged = np.zeros(MARKERS, dtype=bool)
    damaged[list(defects._damages)] = True
    for one, other, _ in defects._bridges:
        damaged[[one, other]] = True
    return np.linalg.norm(model.rest - frame.position, axis=1), damaged & model.visible, model


@pytest.mark.parametrize(
    ("preset", "changed", "median"),
    [("typical", {"bridges": 4}, 0.12), ("hard", {"damaged": 0.0}, 0.2)],
)
def test_the_centre_of_a_joined_dot_is_that_of_its_outline(
    preset: str, changed: dict[str, float], median: float
) -> None:
    found = [errors_at_rest(preset, seed, **changed) for seed in range(4)]
    assert np.median(np.concatenate([off[damaged] for off, damaged, _ in found])) < median


@pytest.mark.parametrize("preset", ["clean", "typical", "print"])
def test_few_undamaged_dots_have_a_mask_and_none_is_lost(preset: str) -> None:
    off, _, model = errors_at_rest(preset, seed=3)
    assert (model.mask_of >= 0).mean() < 0.02 and model.visible.all()
    assert np.quantile(off, 0.95) < 0.08


def test_the_tracker_refuses_masks_that_do_not_fit() -> None:
    n = 9
    setup: dict[str, Any] = {
        **{"width": 60, "height": 60, "channel": 1, "bright": False, "rows": 3, "cols": 3, "spacing": 20.0},
        **{"radius": 4.0, "noise": 0.02, "profile_reach": 4.84, "contrast": np.full(n, -0.5)},
        **{"profile": np.linspace(1, 0, PROFILE_STEPS + 1, dtype=np.float32), "visible": np.ones(n, dtype=bool)},
        **{"rest": np.full((n, 2), 30.0), "tolerated": np.full(n, 0.2)},
        "shape": np.tile([0.25, 0, 0, 0.25, 0, 0, 0, 0], (n, 1)),
    }
    masks = np.ones((1, MASK_CELLS, MASK_CELLS), dtype=np.float32)
    Tracker(**setup, mask_of=np.zeros(n, dtype=int), masks=masks)
    for mask_of, wrong, reason in [
        (np.ones(n, dtype=int), masks, "mask that does not exist"),
        (np.full(n, -2), masks, "mask that does not exist"),
        (np.zeros(n - 1, dtype=int), masks, "mask_of has a shape"),
        (np.zeros(n, dtype=int), masks[:, 1:], "masks must have shape"),
        (np.zeros(n, dtype=int), np.full_like(masks, np.nan), "weight outside 0 to 1"),
        (np.zeros(n, dtype=int), 0 * masks, "does not determine the centre"),
    ]:
        with pytest.raises(ValueError, match=reason):
            Tracker(**setup, mask_of=mask_of, masks=wrong)
