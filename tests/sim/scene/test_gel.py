"""Gels: the elastic layer against closed forms and limits, and gels in scenes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gelflow.errors import UsageError
from gelflow.gel.elastic_layer import half_space_response, layer_response
from gelflow.observation import Grid
from gelflow.sim.benchmark.describe import describe
from gelflow.sim.scene import Scene, load_scene
from gelflow.sim.scene.gel import LayerGel, SpringGel
from gelflow.sim.scene.geometry.sampling import disc_lattice
from gelflow.sim.simulator import Simulator
from gelflow.sim.torch_layer import torch_rollout, torch_state

E, NU = 1e5, 0.4
G = E / (2 + 2 * NU)


def on_grid(rows: int, cols: int, pitch: float, thickness: float, nu: float = NU) -> LayerGel:
    positions = Grid(rows, cols, pitch * 1e3).positions() * 1e-3
    return LayerGel(E, nu, thickness, positions, pitch**2, (rows, cols))


def scattered(count: int, thickness: float, nu: float = NU) -> LayerGel:
    return LayerGel(E, nu, thickness, disc_lattice(0.01, count), np.pi * 1e-4 / count, None)


@pytest.mark.parametrize("nu", [-0.5, 0.0, 0.3, 0.49])
def test_layer_response_solves_the_equilibrium_equations(nu: float) -> None:
    """exp(±kz) (A + Bz), fitted to the boundary conditions with k = G = 1, against the closed forms."""
    kappa, lame = 3 - 4 * nu, 2 * nu / (1 - 2 * nu)

    def wave(z: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Tangential and normal displacement and their z derivatives, as coefficients of A+, B+, A−, B−."""
        up, down = np.exp(z), np.exp(-z)
        along = np.array([up, (kappa + z) * up, -down, (kappa - z) * down])
        out = np.array([up, z * up, down, z * down])
        along_slope = np.array([up, (kappa + z + 1) * up, down, (z - kappa - 1) * down])
        out_slope = np.array([up, (1 + z) * up, -down, (1 - z) * down])
        return along, out, along_slope, out_slope

    along, out, along_slope, out_slope = wave(0.0)
    for w in (0.1, 1.0, 4.0):
        conditions = np.stack([*wave(-w)[:2], along_slope + out, (lame + 2) * out_slope - lame * along])
        by_shear, by_pull = np.linalg.solve(conditions, np.eye(4)[:, 2:]).T
        expected = [np.tanh(w), along @ by_shear, -along @ by_pull, out @ by_pull]
        np.testing.assert_allclose(layer_response(np.array(w), nu), expected, atol=1e-12)
        assert -out @ by_shear == pytest.approx(expected[2], abs=1e-12)
    np.testing.assert_allclose(layer_response(np.array(30.0), nu), half_space_response(nu), atol=1e-12)
    np.testing.assert_allclose(layer_response(np.array(1e4), nu), half_space_response(nu), atol=1e-12)


def test_half_space_agrees_with_boussinesq_and_cerruti() -> None:
    pitch, rows = 1e-3, 25
    matrix = on_grid(rows, 3, pitch, np.inf).compliance_matrix.reshape(rows, 3, 3, rows, 3, 3)
    # The mean distance⁻¹ of two points of a unit square is 4 (asinh 1 − (√2 − 1)/3).
    own = 4 * (np.arcsinh(1) - (np.sqrt(2) - 1) / 3) / (2 * np.pi * G * pitch)
    assert matrix[0, 0, 2, 0, 0, 2] == pytest.approx((1 - NU) * own, rel=1e-12)
    assert matrix[0, 0, 0, 0, 0, 0] == pytest.approx((1 - NU / 2) * own, rel=1e-12)
    # Far away a point load, at distance r along x: shear along x and y, normal, and their coupling.
    far, r = matrix[-1, 0, :, 0, 0, :], (rows - 1) * pitch
    point = np.diag([1, 1 - NU, 1 - NU]) / (2 * np.pi * G * r)
    point[0, 2], point[2, 0] = -(1 - 2 * NU) / (4 * np.pi * G * r), (1 - 2 * NU) / (4 * np.pi * G * r)
    np.testing.assert_allclose(far, point, rtol=1e-3, atol=1e-18)
    # A round cell: the mean distance⁻¹ of two points of a disc is 16 / (3 π a).
    disc = scattered(50, np.inf)
    own = 16 / (3 * np.pi * np.sqrt(disc.cell_area / np.pi)) / (2 * np.pi * G)
    assert disc.compliance_matrix[2, 2] == pytest.approx((1 - NU) * own, rel=1e-4)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
@pytest.mark.parametrize("thickness", [2e-5, 2e-4, 6e-4])
def test_thin_layer_displaces_under_its_local_load(nu: float, thickness: float) -> None:
    """u = τ h / G in shear and p h (1 − 2ν) / (2 G (1 − ν)) in the normal, at the centre of a wide uniform load."""
    gel = on_grid(21, 21, 1e-3, thickness, nu)
    stress, middle = 100.0, 10 * 21 + 10
    shear_modulus = E / (2 + 2 * nu)
    for axis, yields in ((0, 1.0), (1, 1.0), (2, (1 - 2 * nu) / (2 - 2 * nu))):
        forces = np.zeros((21 * 21, 3))
        forces[:, axis] = stress * gel.cell_area
        expected = np.zeros(3)
        expected[axis] = stress * thickness / shear_modulus * yields
        np.testing.assert_allclose(gel.displacement(forces)[middle], expected, atol=2e-5 * stress * thickness / G)
    if thickness < 1e-4:  # a single marker displaces its own cell only, except at the borders of adjacent cells
        alone = gel.compliance_matrix[::3, 3 * middle] * shear_modulus * gel.cell_area / thickness
        assert alone[middle] == pytest.approx(1, abs=0.1)
        assert np.abs(np.delete(alone, [middle, middle - 1, middle + 1, middle - 21, middle + 21])).max() < 1e-3


@pytest.mark.parametrize(
    "make", [lambda h: on_grid(6, 5, 1e-3, h), lambda h: scattered(30, h)], ids=["squares", "discs"]
)
def test_thick_layer_converges_to_the_half_space(make: Any) -> None:
    half = make(np.inf).compliance_matrix
    difference = [np.abs(make(h).compliance_matrix - half).max() / half.max() for h in (0.05, 0.5, 5.0)]
    assert difference[0] < 0.05 and difference[2] < 3e-4
    np.testing.assert_allclose(np.divide(difference[:2], difference[1:]), 10, rtol=0.1)  # ∝ 1/h


@pytest.mark.parametrize(("nu", "thickness"), [(0.5, 1e-4), (0.5, 3e-3), (0.0, 3e-3), (-0.9, 3e-3), (0.5, np.inf)])
def test_compliance_is_symmetric_positive_definite(nu: float, thickness: float) -> None:
    rng = np.random.default_rng(0)
    random_markers = LayerGel(E, nu, thickness, rng.uniform(0, 0.01, (40, 2)), 1e-6, None)
    for gel in (on_grid(8, 5, 1.5e-3, thickness, nu), scattered(60, thickness, nu), random_markers):
        matrix = gel.compliance_matrix
        np.testing.assert_array_equal(matrix, matrix.T)
        eigenvalues = np.linalg.eigvalsh(matrix)
        assert eigenvalues[0] > 1e-4 * eigenvalues[-1]


@pytest.mark.parametrize("thickness", [3e-4, 3e-3, np.inf])
def test_averaged_fine_cells_equal_coarse_cells(thickness: float) -> None:
    coarse, fine = (
        on_grid(4, 3, 2e-3, thickness).compliance_matrix,
        on_grid(12, 9, 2e-3 / 3, thickness).compliance_matrix,
    )
    row, col = np.divmod(np.arange(108), 9)
    member = np.zeros((12, 108))
    member[row // 3 * 3 + col // 3, np.arange(108)] = 1 / 9
    spread = np.kron(member, np.eye(3))
    np.testing.assert_allclose(spread @ fine @ spread.T, coarse, atol=1e-10 * coarse.max())


def test_displacement_converges_with_grid_refinement() -> None:
    """A Gaussian load 3 mm wide on 15 × 15 mm: the error at the centre is of second order in the pitch."""

    def middle(cells: int) -> Any:
        gel = on_grid(cells, cells, 0.015 / cells, 4e-3)
        bell = np.exp(-(gel.positions**2).sum(1) / 0.003**2)[:, None] * [1000.0, 0.0, 2000.0]
        return gel.displacement(bell * gel.cell_area)[cells * cells // 2]

    coarse, medium, fine = middle(11), middle(17), middle(27)
    expected = (11**-2 - 17**-2) / (17**-2 - 27**-2)
    np.testing.assert_allclose(((coarse - medium) / (medium - fine))[[0, 2]], expected, rtol=0.15)
    np.testing.assert_allclose(medium[[0, 2]], fine[[0, 2]], rtol=0.02)


def test_compliance_is_invariant_under_rotation() -> None:
    gel = scattered(40, 3e-3)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    rotated = replace(gel, positions=gel.positions @ turn[:2, :2].T)
    every = np.kron(np.eye(40), turn)
    np.testing.assert_allclose(
        rotated.compliance_matrix, every @ gel.compliance_matrix @ every.T, atol=1e-9 * gel.compliance_matrix.max()
    )
    # A rectangle rotated by 90°: x becomes y, y becomes −x, rows become columns.
    wide, tall = (on_grid(*n, 1e-3, 2e-3).compliance_matrix.reshape(*n, 3, *n, 3) for n in ((3, 7), (7, 3)))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = np.einsum("ax,ijxklz,bz->ijaklb", quarter, tall, quarter).transpose(1, 0, 2, 4, 3, 5)
    np.testing.assert_allclose(wide[::-1, :, :, ::-1], expected, atol=1e-12 * wide.max())


def test_round_cells_approximate_square_cells() -> None:
    square = on_grid(6, 5, 1.5e-3, 4e-3)
    disc = replace(square, grid_shape=None)
    assert np.abs(disc.compliance_matrix - square.compliance_matrix).max() < 0.015 * square.compliance_matrix.max()
    far = np.abs(square.positions - square.positions[0]).max(1) > 4e-3
    difference = (disc.compliance_matrix - square.compliance_matrix).reshape(30, 3, 30, 3)[far, :, 0]
    assert np.abs(difference).max() < 2e-3 * square.compliance_matrix.max()


MODEL = """<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 1"/>
    <body name="finger" pos="0 0 0.009">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="finger" type="sphere" size="0.01"/>
      <site name="tip" pos="0 0 -0.0095" xyaxes="0 1 0 1 0 0"/>
    </body>
  </worldbody>
  <actuator><position joint="x" kp="10"/><position joint="z" kp="10"/></actuator>
</mujoco>"""

PAD = """[pads.NAME]
site = "tip"
SHAPE
against = "ground"
kn = 100.0
kt = 1.0
mu = 1.0
kd = 1.0
"""
RECTANGLE = "rows = 4\ncols = 3\npitch = 1e-3\n"
LAYER = "gel = { youngs_modulus = 1e5, poisson_ratio = 0.45, thickness = 3e-3 }"


def scene_with(folder: Path, **pads: str) -> Scene:
    (folder / "s.xml").write_text(MODEL)
    tables = "".join(PAD.replace("NAME", name).replace("SHAPE", shape) for name, shape in pads.items())
    (folder / "s.toml").write_text('format = 1\nmodel = "s.xml"\nstep = 0.005\n' + tables)
    return load_scene(folder / "s.toml")


def test_displacements_of_all_pads(tmp_path: Path) -> None:
    scene = scene_with(
        tmp_path,
        layer=RECTANGLE + LAYER,
        springs=RECTANGLE + "gel = { compliance = 0.01 }",
        both='shape = "disc"\nradius = 2e-3\ncount = 9\ngel = { compliance = 0.01, normal_compliance = 0.002 }',
    )
    sim = Simulator(scene, num_envs=3)
    sim.q[:, 1] = [0, 1e-4, 2e-4]
    sim.v[:, 0] = [0.1, 0.2, 0.3]
    forces, moved = sim.tactile().copy(), sim.displacement()
    assert moved.shape == (3, 33, 3) and np.abs(forces).max() > 0
    layer = scene.pads[0].gel
    assert isinstance(layer, LayerGel) and layer.grid_shape == (4, 3) and layer.cell_area == pytest.approx(1e-6)
    expected = forces[:, :12].reshape(3, 36) @ layer.compliance_matrix
    np.testing.assert_allclose(moved[:, :12], expected.reshape(3, 12, 3), atol=1e-15)
    np.testing.assert_allclose(moved[:, 12:24], 0.01 * forces[:, 12:24])
    np.testing.assert_allclose(moved[:, 24:], [0.01, 0.01, 0.002] * forces[:, 24:])
    run = sim.rollout(np.zeros((4, 3, 2)), read_after=(0, 2, 4))
    np.testing.assert_array_equal(sim.displacement(run.tactile)[0], moved)
    single = Simulator(scene, precision="single")
    single.v[:, 0] = 0.1
    assert single.displacement().dtype == np.float32
    np.testing.assert_allclose(single.displacement()[0], moved[0], rtol=1e-4, atol=1e-5 * np.abs(moved[0]).max())


def test_gradients_through_the_gel(tmp_path: Path) -> None:
    """Adjoint identity ⟨M f, w⟩ = ⟨f, Mᵀ w⟩, and gradients through a rollout to its controls."""
    scene = scene_with(tmp_path, layer=RECTANGLE + LAYER, springs=RECTANGLE + "gel = { compliance = 0.01 }")
    sim = Simulator(scene, num_envs=2)
    rng = np.random.default_rng(1)
    weights = rng.normal(size=(5, 2, 24, 3))
    forces = torch.tensor(rng.normal(size=(5, 2, 24, 3)), requires_grad=True)
    displacement = sim.displacement(forces)
    np.testing.assert_allclose(displacement.detach().numpy(), sim.displacement(forces.detach().numpy()), rtol=1e-13)
    (displacement * torch.from_numpy(weights)).sum().backward()
    assert forces.grad is not None
    np.testing.assert_allclose(forces.grad.numpy(), sim.displacement(weights), rtol=1e-10, atol=1e-14)
    assert sim.displacement(forces.detach().float()).dtype == torch.float32

    controls = torch.full((6, 2, 2), -1e-3, dtype=torch.float64, requires_grad=True)

    def loss(u: torch.Tensor) -> torch.Tensor:
        displacement: torch.Tensor = sim.displacement(
            torch_rollout(sim, torch_state(sim), u, read_after=(4, 6)).tactile
        )
        return 1e6 * (displacement**2).sum()

    assert torch.autograd.gradcheck(loss, (controls,), eps=1e-7, rtol=1e-4)


def test_listed_markers_on_an_inclined_plane(tmp_path: Path) -> None:
    """Rotated coplanar markers give the same gel; the cell area follows from their distances."""
    flat = np.array([[i * 1e-3, j * 1e-3, 0] for i in range(4) for j in range(3)])
    x, y, z = np.array([0.6, 0, -0.8]), np.array([0.0, 1, 0]), np.array([0.8, 0, 0.6])
    inclined = flat @ np.stack([x, y, z]) + [1e-3, 0, 2e-3]
    text = 'shape = "points"\npositions = {}\nnormals = {}\nx_axes = {}\n'
    shape = text.format(inclined.tolist(), [z.tolist()] * 12, [x.tolist()] * 12)
    gel = scene_with(tmp_path, pad=shape + LAYER).pads[0].gel
    assert isinstance(gel, LayerGel) and gel.grid_shape is None
    assert gel.cell_area == pytest.approx(1e-6)
    np.testing.assert_allclose(gel.positions, flat[:, :2], atol=1e-15)


HEMISPHERE = 'shape = "hemisphere"\nradius = 5e-3\ncount = 20\n'
INVALID_GELS = {
    "gel = {}": "either compliance, or youngs_modulus, poisson_ratio and thickness",
    "gel = { complience = 1.0 }": "unknown key 'complience'; did you mean 'compliance'",
    "gel = { compliance = 1.0, youngs_modulus = 1.0 }": "unknown key 'youngs_modulus'",
    "gel = { compliance = -1.0 }": "compliance must be a finite number ≥ 0",
    "gel = { youngs_modulus = 1e5, thickness = 1.0 }": "poisson_ratio is missing",
    "gel = { youngs_modulus = 1e5, poisson_ratio = 0.51, thickness = 1 }": (
        "poisson_ratio must be above -1 and at most 0.5, got 0.51"
    ),
    "gel = { youngs_modulus = 1, poisson_ratio = 0, thickness = 0}": "thickness must be a finite number ≥ 1e-09, got 0",
    "gel = { youngs_modulus = inf, poisson_ratio = 0.4, thickness = 1.0 }": "youngs_modulus must be a finite number",
    "gel = { modulus = 1e5 }": "unknown key 'modulus'; it is now called 'youngs_modulus'",
    "gel = { poisson = 0.4 }": "unknown key 'poisson'; it is now called 'poisson_ratio'",
    "gel = { compliance = 1.0, normal = 1.0 }": "unknown key 'normal'; it is now called 'normal_compliance'",
    "gel = 3": "gel must be a table",
}


@pytest.mark.parametrize("text", INVALID_GELS)
def test_invalid_gel_gives_a_one_line_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(UsageError) as error:
        scene_with(tmp_path, pad=RECTANGLE + text)
    assert INVALID_GELS[text] in str(error.value) and "pads.pad" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("shape", "why"),
    [
        (HEMISPHERE, "a layer needs coplanar markers"),
        (
            'shape = "points"\npositions = [[0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 1e-4]]\n',
            "a layer needs coplanar markers",
        ),
        ('shape = "points"\npositions = [[0, 0, 0]]\n', "needs at least two markers"),
        ('shape = "points"\npositions = [[0, 0, 0], [0, 0, 0], [1e-3, 0, 0]]\n', "have the same position"),
        ("rows = 40\ncols = 30\npitch = 1e-3\n", "supports at most 1000 markers, got 1200"),
    ],
)
def test_markers_that_do_not_support_a_layer(tmp_path: Path, shape: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        scene_with(tmp_path, pad=shape + LAYER)
    assert isinstance(scene_with(tmp_path, pad=shape + "gel = { compliance = 1.0 }").pads[0].gel, SpringGel)


def test_a_gel_file_is_the_same_as_its_values(tmp_path: Path) -> None:
    (tmp_path / "gel.toml").write_text(
        "format = 1\n[gel]\nyoungs_modulus = 1e5\npoisson_ratio = 0.48\nthickness = 4e-3\ncreep = 0.1\n"
    )
    gel = scene_with(tmp_path, pad=RECTANGLE + 'gel = "gel.toml"').pads[0].gel
    assert isinstance(gel, LayerGel)
    assert (gel.youngs_modulus, gel.poisson_ratio, gel.thickness) == (1e5, 0.48, 4e-3)
    with pytest.raises(UsageError, match=r"none\.toml"):
        scene_with(tmp_path, pad=RECTANGLE + 'gel = "none.toml"')


def test_displacement_needs_a_gel(tmp_path: Path) -> None:
    scene = scene_with(tmp_path, first=RECTANGLE + LAYER, second=RECTANGLE)
    with pytest.raises(UsageError, match=r"pad 'second' has no gel; give pads\.second\.gel in the scene"):
        Simulator(scene).displacement()
    with pytest.raises(UsageError, match="needs a scene with pads"):
        Simulator(scene.build()).displacement()
    half_space = scene_with(
        tmp_path, pad=RECTANGLE + "gel = { youngs_modulus = 1.0, poisson_ratio = 0, thickness = inf }"
    )
    assert isinstance(half_space.pads[0].gel, LayerGel) and half_space.pads[0].gel.thickness == np.inf
    with pytest.raises(UsageError, match=r"forces must have shape \(…, 12, 3\), got \(12, 2\)"):
        Simulator(half_space).displacement(np.zeros((12, 2)))


def test_describe_shows_the_gel(tmp_path: Path) -> None:
    pads = describe(load_scene("insertion")).pads
    assert [pad.gel for pad in pads] == ["compliance 10 mm/N in shear, 10 mm/N into the pad"] * 2
    layer = {"youngs_modulus": 1e5, "poisson_ratio": 0.45, "thickness": 3e-3}
    pads = describe(load_scene("insertion", overrides={"pads.*.gel": layer})).pads
    assert pads[1].gel == "layer of 3 mm, 100000 Pa, Poisson's ratio 0.45"
    assert describe(load_scene("rolling")).pads[0].gel is None
