"""The accurate gel renderer: ground truth, image degradations and repeatability."""

from typing import Any

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from gelflow.errors import UsageError
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.appearance import FACTORS, PRESETS, SIZES, GelAppearance, make_appearance
from gelflow.perception.synthetic.fast_renderer import FastGelRenderer
from gelflow.perception.synthetic.sequences import FIELDS, GelSequence

# Uniform light without noise, so that the centre of a dot is the centroid of its ink.
EVEN: dict[str, Any] = {
    **{"noise": 0.0, "shot": 0.0, "gradient": 0.0, "colour": 0.0, "shading": 0.0, "ridges": 0.0, "dust": 0},
    **{"occluders": 0, "damaged": 0.0, "bridges": 0, "missing": 0.0, "quality": 100},
}


def ink_of(picture: np.ndarray) -> np.ndarray:
    """Difference from the gel, for uniform light."""
    return np.asarray(picture[..., 1] - np.median(picture[..., 1]))


def centroids(picture: np.ndarray, centers: np.ndarray, reach: int) -> np.ndarray:
    """Centroid of the ink within `reach` pixels of each of `centers`, for uniform light."""
    found = np.zeros_like(centers)
    ink = ink_of(picture)
    for k, (right, down) in enumerate(np.rint(centers).astype(int)):
        y, x = np.mgrid[down - reach : down + reach + 1, right - reach : right + reach + 1]
        patch = ink[y, x]
        found[k] = (patch * x).sum() / patch.sum(), (patch * y).sum() / patch.sum()
    return found


def areas(picture: np.ndarray, centers: np.ndarray, reach: int) -> np.ndarray:
    """Sum of the ink within `reach` pixels of each of `centers`, for uniform light."""
    ink = ink_of(picture)
    squares = [ink[y - reach : y + reach + 1, x - reach : x + reach + 1] for x, y in np.rint(centers).astype(int)]
    return np.array([square.sum() for square in squares])


@pytest.mark.parametrize(
    "changed",
    [
        {},
        {"blur": 2.0},
        {"keystone": 0.15, "barrel": 0.05},
        {"oval": 1.8, "barrel": 0.02},
        {"bright": True, "contrast": 0.5},
    ],
    ids=lambda changed: " ".join(changed) or "plain",
)
def test_the_ground_truth_is_the_centroid_of_the_ink(changed: dict[str, Any]) -> None:
    appearance = make_appearance("typical", markers=63, seed=1, **{**EVEN, **changed})
    rest = appearance.positions_mm()
    strain = np.array([[0.08, 0.05], [-0.07, -0.03]])
    exposed = AccurateGelRenderer(appearance).render_noiseless((rest - rest.mean(axis=0)) @ strain)
    assert exposed.visible.all()
    off = centroids(exposed.picture, exposed.position, reach=12) - exposed.position
    assert np.abs(off).max() < 0.003


@pytest.mark.parametrize("oval", [1.0, 1.6])
def test_dots_deform_like_the_image_of_the_gel(oval: float) -> None:
    appearance = make_appearance("clean", markers=63, width=640, height=480, **{**EVEN, "oval": oval})
    renderer, rest = AccurateGelRenderer(appearance), appearance.positions_mm()
    middle = np.array([(appearance.width - 1) / 2, (appearance.height - 1) / 2])

    def moved(at: np.ndarray) -> np.ndarray:
        """Displacement [px] of a position relative to the middle of the image [px], both of shape (n, 2)."""
        right, down = at.T
        return np.stack([4e-4 * right**2 - 2e-4 * right * down, 3e-4 * down**2 + 2e-4 * right**2], axis=1)

    at = appearance.to_pixels(rest)
    mm_to_px = appearance.to_pixels(rest[0] + np.eye(2)) - at[0]
    curved = renderer.render_noiseless(moved(at - middle) @ np.linalg.inv(mm_to_px))
    still = renderer.render_noiseless(np.zeros_like(rest))
    pixels = np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1).reshape(-1, 2) - middle
    source = pixels.copy()
    for _ in range(40):
        source = pixels - moved(source)
    right, down = (source + middle).T
    green = map_coordinates(still.picture[..., 1], (down, right), mode="nearest").reshape(480, 640)
    warped = np.stack([green] * 3, axis=-1)
    inner = np.arange(63).reshape(7, 9)[1:-1, 1:-1].ravel()  # border dots have no second differences
    found, expected = (centroids(picture, curved.position, reach=22) for picture in (curved.picture, warped))
    assert np.linalg.norm(expected - curved.position, axis=1)[inner].min() > 0.03
    assert np.abs(found - expected)[inner].max() < 0.006
    area, expected_area = (areas(picture, curved.position, reach=22) for picture in (curved.picture, warped))
    assert np.abs(area / expected_area - 1).max() < 0.01  # also at the border


def test_printed_dots_are_off_the_grid() -> None:
    regular, printed = (
        AccurateGelRenderer(make_appearance("clean", markers=252, print_offset=offset)) for offset in (0.0, 0.02)
    )
    still = np.zeros((252, 2))
    off = printed.render_noiseless(still).position - regular.render_noiseless(still).position
    assert off.std() == pytest.approx(0.02 * printed.appearance.spacing, rel=0.1)


def test_motion_blur_lengthens_a_dot_and_keeps_its_centre() -> None:
    appearance = make_appearance("typical", markers=63, **EVEN)
    renderer, still = AccurateGelRenderer(appearance), np.zeros((63, 2))
    smeared = renderer.render_noiseless(still, motion_blur=np.tile([4.0, 0.0], (63, 1)))
    off = centroids(smeared.picture, smeared.position, reach=12) - smeared.position
    assert np.abs(off).max() < 0.003
    plain = renderer.render_noiseless(still).picture
    ink = [(np.median(picture) - picture[..., 1]).clip(0) for picture in (plain, smeared.picture)]
    right = np.arange(appearance.width)
    variance = []
    for layer in ink:  # horizontal variance of the first dot; convolution with a box of 4 px adds 4²/12
        x, y = np.rint(smeared.position[0]).astype(int)
        weight = layer[y - 12 : y + 13, x - 12 : x + 13].sum(axis=0)
        at = right[x - 12 : x + 13]
        mean = (weight * at).sum() / weight.sum()
        variance.append((weight * (at - mean) ** 2).sum() / weight.sum())
    assert variance[1] - variance[0] == pytest.approx(16 / 12, rel=0.05)


@pytest.mark.parametrize("field", FIELDS)
def test_a_sequence_moves_from_rest_to_its_peak_and_back(field: Any) -> None:
    appearance = make_appearance("hard", markers=63, seed=2)
    sequence = GelSequence(appearance, field, peak=0.4)
    frames = [sequence.displacement(number) for number in range(len(sequence))]
    lengths = np.linalg.norm(frames, axis=-1).max(axis=1) / appearance.grid.pitch
    assert not lengths[:4].any() and lengths[-1] < 1e-12
    assert 0.35 < lengths.max() <= 0.4
    steps = np.linalg.norm(np.diff(frames, axis=0), axis=-1).max() / appearance.grid.pitch
    assert steps < 0.05, "smooth"
    jump = GelSequence(appearance, field, peak=0.7, motion="jump")
    assert (
        not jump.displacement(2).any()
        and np.linalg.norm(jump.displacement(3), axis=1).max() > 0.6 * appearance.grid.pitch
    )


def test_equal_sequences_give_identical_images() -> None:
    appearance = make_appearance("hard", seed=5)
    one, other = (list(GelSequence(appearance, "slip", frames=6)) for _ in range(2))
    assert [frame.jpeg for frame in one] == [frame.jpeg for frame in other]
    assert len({frame.jpeg for frame in one}) == 6, "the noise differs between images, also at rest"
    assert next(iter(GelSequence(make_appearance("hard", seed=6), frames=1))).jpeg != one[0].jpeg


def test_an_image_does_not_depend_on_the_images_before_it() -> None:
    appearance = GelAppearance(seed=3)
    rest = np.zeros((appearance.grid.rows * appearance.grid.cols, 2))
    displacements = [rest, rest, rest + 0.3, rest + 0.3, rest]
    renderer = FastGelRenderer(appearance)
    for number, displacement in enumerate(displacements):
        alone = FastGelRenderer(appearance).render(displacement, sequence=number)
        np.testing.assert_array_equal(renderer.render(displacement, sequence=number), alone)


def test_occluded_markers_are_temporarily_not_visible() -> None:
    sequence = list(GelSequence(make_appearance("typical", occluders=2, missing=0.05, seed=1), frames=25))
    visible = np.array([frame.visible for frame in sequence])
    assert visible[0].sum() == visible[-1].sum() == 130 - round(0.05 * 130)
    hidden_once = visible[0] & ~visible.all(axis=0)
    assert 8 < hidden_once.sum() < 80
    for frame in sequence:  # a visible dot is darker than its surroundings
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        right, down = np.rint(frame.position[visible[0] & frame.visible]).astype(int).T
        assert (grey[down, right] < 0.8 * cv2.blur(grey, (23, 23))[down, right]).all()


@pytest.mark.parametrize(
    ("name", "markers"), [*((name, 130) for name in (*PRESETS, *FACTORS)), *(("hard", markers) for markers in SIZES)]
)
def test_every_image_class_factor_and_size_can_be_rendered(name: str, markers: int) -> None:
    appearance = (
        make_appearance(name, markers=markers) if name in PRESETS else make_appearance(markers=markers, **FACTORS[name])
    )
    frame = next(iter(GelSequence(appearance, frames=1)))
    assert frame.image.shape == (240, 320, 3) and frame.position.shape == (markers, 2)
    rows = frame.position.reshape(appearance.grid.rows, appearance.grid.cols, 2)
    assert (np.diff(rows[..., 0], axis=1) > 0).all() and (np.diff(rows[..., 1], axis=0) > 0).all()
    assert frame.visible.sum() == markers - round(appearance.missing * markers)


def test_invalid_appearances_and_sequences_are_rejected() -> None:
    for wrong, message in (
        ({"preset": "dirty"}, "image class must be one of clean, typical, hard, print, got 'dirty'"),
        ({"markers": 100}, "markers must be one of 35, 63, 130, 154, 252, got 100"),
        ({"blurr": 1.0}, "a gel appearance has no field 'blurr'; fields are barrel"),
        ({"damaged": 1.5}, "damaged of a gel appearance must be within 0.0 to 1.0, got 1.5"),
        ({"blur": 0.2}, "blur of a gel appearance must be within 0.5"),
    ):
        with pytest.raises(UsageError, match=message):
            make_appearance(**wrong)
    with pytest.raises(UsageError, match="field must be one of press, shear, twist, slip"):
        GelSequence(make_appearance(), "pull")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="at least 1 frame"):
        GelSequence(make_appearance(), frames=0)
    with pytest.raises(UsageError, match="finite"):
        AccurateGelRenderer(make_appearance()).render(np.full((130, 2), np.nan))
