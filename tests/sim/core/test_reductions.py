"""Reductions of marker forces in the core: equal to the matrix product, with physical meaning, for any threads."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.sim import reductions
from gelflow.sim.reductions import TactileReduction
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.scene.gel import SpringGel
from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.reference_motions import reference_motion

ENVS = 4

Array = NDArray[Any]


@pytest.fixture(scope="module", params=["rolling", "insertion", "dclaw"])
def scene(request: pytest.FixtureRequest) -> Scene:
    overrides = {"pads.pad.rows": 12, "pads.pad.cols": 12} if request.param == "rolling" else {}
    return load_scene(request.param, friction="elastic", overrides=overrides)


def in_contact(scene: Scene, *, threads: int = 1, precision: Any = "double") -> tuple[Simulator, Array]:
    """Environments 0.3 s into the reference motion, and controls of the next steps."""
    motion = reference_motion(scene)
    u = motion.step_controls(scene.step)
    start = round(0.3 / scene.step)
    sim = Simulator(scene, num_envs=ENVS, threads=threads, precision=precision)
    sim.q[:] = motion.q0
    sim.param(f"{scene.pads[0].name}.kn")[:] *= 1 + 0.1 * np.arange(ENVS)
    for now in u[:start]:
        sim.step(now)
    sim.check()
    return sim, np.repeat(u[start : start + 4, None], ENVS, axis=1)


def random_rows(scene: Scene) -> TactileReduction:
    matrix = np.random.default_rng(1).normal(size=(7, scene.num_markers, 3))
    matrix[3] = 0
    matrix[4:6, : scene.num_markers // 2] = 0
    return TactileReduction(matrix, tuple("abcdefg"))


@pytest.mark.parametrize("precision", ("double", "single"))
def test_core_and_matrix_product_agree(scene: Scene, precision: str) -> None:
    reduction = random_rows(scene)
    sim, u = in_contact(scene, precision=precision)
    expected = reduction(sim.tactile().astype(float))
    assert expected.any()
    tolerance = 1e-13 if precision == "double" else 1e-6
    rows = sim.tactile(reduction=reduction)
    assert rows.shape == (ENVS, 7) and rows.dtype == sim.dtype
    np.testing.assert_allclose(rows, expected, rtol=0, atol=tolerance * np.abs(expected).max())
    full, reduced = (sim.rollout(u, read_after=(0, 2, 4), reduction=r) for r in (None, reduction))
    expected = reduction(full.tactile.astype(float))
    assert reduced.tactile.shape == (3, ENVS, 7)
    np.testing.assert_allclose(reduced.tactile, expected, rtol=0, atol=tolerance * np.abs(expected).max())
    np.testing.assert_array_equal(reduced.q, full.q)
    out = np.full((ENVS, 7), 5.0, sim.dtype)
    active = np.array([True, False, True, False])
    assert sim.tactile(out, reduction=reduction, active=active) is out
    np.testing.assert_array_equal(out[active], rows[active])
    assert (out[~active] == 5).all() and not sim.tactile(reduction=reduction, active=active)[~active].any()


def test_results_do_not_depend_on_threads(scene: Scene) -> None:
    reduction = random_rows(scene)
    results = []
    for threads in (1, 3):
        sim, u = in_contact(scene, threads=threads)
        run = sim.rollout(u, read_after=(1, 4), reduction=reduction)
        gradient = sim.rollout_gradient(run, tactile=1.0)
        results.append((sim.tactile(reduction=reduction), run.tactile, gradient.u, gradient.q))
    for one, three in zip(*results, strict=True):
        assert one.tobytes() == three.tobytes()


def test_forces_and_moments_of_pads(scene: Scene) -> None:
    """The sums of the force vectors at the markers, in the frame of the pad's site."""
    sim, _ = in_contact(scene)
    parts = (reductions.pad_forces(scene), reductions.pad_moments(scene), reductions.mean_shear(scene))
    reduction = TactileReduction.concatenate(parts)
    rows = dict(zip(reduction.names, sim.tactile(reduction=reduction).T, strict=True))
    for pad in scene.pads:
        readings = sim.tactile()[:, sim.marker_slice(pad.name)] * [1, 1, -1]
        in_body = np.einsum("mij,nmj->nmi", pad.axes, readings)
        rotation = pad.pose.matrix()
        arms = pad.positions - pad.positions.mean(0)
        expected = {"force": in_body.sum(1) @ rotation, "moment": np.cross(arms, in_body).sum(1) @ rotation}
        for name, value in expected.items():
            ours = np.stack([rows[f"{pad.name}.{name}.{axis}"] for axis in "xyz"], axis=1)
            np.testing.assert_allclose(ours, value, rtol=1e-9, atol=1e-14, err_msg=name)
        shear = np.stack([rows[f"{pad.name}.mean_shear.{axis}"] for axis in "xy"], axis=1)
        np.testing.assert_allclose(shear, readings[..., :2].mean(1), rtol=1e-9, atol=1e-16)


def test_center_of_pressure_is_the_mean_position_weighted_by_normal_force() -> None:
    scene = load_scene("rolling", overrides={"pads.pad.rows": 12, "pads.pad.cols": 12})
    sim, _ = in_contact(scene)
    pad = scene.pads[0]
    force, moment = (sim.tactile(reduction=r(scene)) for r in (reductions.pad_forces, reductions.pad_moments))
    positions = (pad.positions - pad.positions.mean(0)) @ pad.pose.matrix()
    normal = sim.tactile()[..., 2]
    expected = normal @ positions[:, :2] / normal.sum(1, keepdims=True)
    assert np.abs(expected).max() > 1e-4
    np.testing.assert_allclose(reductions.center_of_pressure(force, moment), expected, rtol=1e-9, atol=1e-12)


def test_pressure_of_curved_pads_is_the_sum_of_normal_forces_and_its_moment(scene: Scene) -> None:
    sim, _ = in_contact(scene)
    rows = sim.tactile(reduction=reductions.pad_pressures(scene)).reshape(ENVS, len(scene.pads), 4)
    assert rows[..., 0].max() > 0
    for pad, row in zip(scene.pads, rows.transpose(1, 0, 2), strict=True):
        normal = sim.tactile()[:, sim.marker_slice(pad.name), 2]
        positions = (pad.positions - pad.pose.position) @ pad.pose.matrix()
        np.testing.assert_allclose(row[:, 0], normal.sum(1), rtol=1e-9, atol=1e-14)
        np.testing.assert_allclose(row[:, 1:], normal @ positions, rtol=1e-9, atol=1e-14)


def test_shear_features_are_projections_of_the_shear_maps() -> None:
    scene = load_scene("insertion")
    sim, _ = in_contact(scene)
    basis = np.random.default_rng(2).normal(size=(len(scene.pads[0].positions), 6))
    rows = sim.tactile(reduction=reductions.shear_features(scene, basis))
    maps = sim.tactile()[..., :2].reshape(ENVS, len(scene.pads), -1, 2).transpose(0, 1, 3, 2)
    np.testing.assert_allclose(rows, (maps @ basis).reshape(ENVS, -1), rtol=1e-9, atol=1e-14)
    one = reductions.shear_features(scene, basis, pads=["right"])
    np.testing.assert_array_equal(sim.tactile(reduction=one), rows[:, 12:])
    assert one.names[:2] == ("right.shear_x.0", "right.shear_x.1") and one.names[6] == "right.shear_y.0"


def test_nested_lists_are_a_matrix() -> None:
    reduction = TactileReduction([[[1, 0, 0], [2, 0, 0]]], ["sum"])  # type: ignore[arg-type]
    assert reduction.names == ("sum",)
    assert reduction([[3, 0, 0], [4, 0, 0]]).tolist() == [11.0]


def test_integers_are_numbers() -> None:
    ones = np.ones((2, 3, 3), dtype=np.int64)
    mean = TactileReduction(np.full((1, 3, 3), 1 / 9), ("mean",))
    assert mean(ones).ravel() == pytest.approx([1.0, 1.0])
    assert mean(torch.from_numpy(ones)).ravel().tolist() == pytest.approx([1.0, 1.0])
    gel = SpringGel(shear_compliance=0.01, normal_compliance=0.02)
    np.testing.assert_allclose(gel.displacement(torch.from_numpy(ones))[0, 0].numpy(), [0.01, 0.01, 0.02])


def test_invalid_reductions_raise() -> None:
    scene = load_scene("insertion")
    sim = Simulator(scene)
    with pytest.raises(UsageError, match="matrix must be finite, of shape"):
        TactileReduction(np.ones((2, 3)), ("a", "b"))
    with pytest.raises(UsageError, match="matrix must be finite, of shape"):
        TactileReduction(np.full((1, 3, 3), np.nan), ("a",))
    with pytest.raises(UsageError, match="expected 1 names of rows, got 2"):
        TactileReduction(np.ones((1, 3, 3)), ("a", "b"))
    with pytest.raises(UsageError, match="matrix must be real"):
        TactileReduction(np.ones((1, 3, 3)) + 1j, ("a",))  # type: ignore[arg-type]
    other = TactileReduction(np.ones((1, 3, 3)), ("a",))
    with pytest.raises(UsageError, match=re.escape("reductions must be of one number of markers, got [3, 260]")):
        TactileReduction.concatenate([other, reductions.pad_forces(scene)])
    with pytest.raises(UsageError, match="reductions must be of one number of markers"):
        TactileReduction.concatenate([])
    for call in (
        lambda: sim.tactile(reduction=other),
        lambda: sim.rollout(np.zeros((2, 1, sim.model.nu)), reduction=other),
    ):
        with pytest.raises(UsageError, match=f"reduction is of 3 markers; the scene has {scene.num_markers}"):
            call()
    with pytest.raises(UsageError, match=re.escape(f"forces must have shape (…, 3, 3), got (1, {scene.num_markers}")):
        other(sim.tactile())
    with pytest.raises(UsageError, match="no pad 'middle'"):
        reductions.pad_forces(scene, ["middle"])
    with pytest.raises(UsageError, match=re.escape("basis must have shape (130, terms) for pad 'left', got (5, 2)")):
        reductions.shear_features(scene, np.ones((5, 2)))
    run = sim.rollout(np.zeros((2, 1, sim.model.nu)), read_after=(1,))
    with pytest.raises(UsageError, match="out must have tactile readings of shape"):
        sim.rollout(np.zeros((2, 1, sim.model.nu)), read_after=(1,), reduction=reductions.pad_forces(scene), out=run)
