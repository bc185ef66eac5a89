"""The public names of gelflow.sim, and the registration of its environments with Gymnasium."""

import subprocess
import sys

import pytest

import gelflow.sim as gs

ENVIRONMENT = "gelflow/Insertion-v0"


def python(code: str) -> str:
    """The output of a program in a fresh interpreter."""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def test_every_public_name_is_listed_and_resolves() -> None:
    assert {"Simulator", "Trajectory", "Scene", "load_scene", "EnergyGauge", "torch_rollout"} <= set(gs.__all__)
    assert set(gs.__all__) <= set(dir(gs))
    assert [name for name in gs.__all__ if not hasattr(gs, name)] == []


def test_a_simulator_of_a_named_scene_takes_a_step() -> None:
    assert "insertion" in gs.scene_names()
    sim = gs.Simulator(gs.load_scene("insertion"), num_envs=3)
    sim.step([0.0] * sim.model.nu)
    sim.check()
    assert sim.tactile().shape == (3, sim.model.num_markers, 3)


@pytest.mark.parametrize("package", ["gelflow", "gelflow.sim", "gelflow.sim.scene"])
def test_importing_a_package_imports_no_heavy_dependency(package: str) -> None:
    heavy = ("torch", "cv2", "mujoco", "matplotlib", "gymnasium", "scipy", "gelflow.sim._core")
    assert python(f"import sys, {package}; print([name for name in {heavy} if name in sys.modules])") == "[]"


@pytest.mark.parametrize("imports", ["import gymnasium, gelflow", "import gelflow, gymnasium", "import gymnasium"])
def test_gymnasium_makes_the_environment_in_any_order_of_imports(imports: str) -> None:
    name = ENVIRONMENT if "gelflow" in imports else f"gelflow:{ENVIRONMENT}"  # "module:id" imports the module first
    code = f"{imports}; env = gymnasium.make({name!r}); print(env.observation_space.shape)"
    assert python(code) == "(4, 13, 10)"


def test_registering_twice_gives_no_warning() -> None:
    code = (
        "import warnings; warnings.simplefilter('error'); import gelflow, gymnasium\n"
        "from gelflow.gymnasium_registration import register_environments, register_when_imported\n"
        f"register_environments(); register_when_imported(); print({ENVIRONMENT!r} in gymnasium.registry)"
    )
    assert python(code) == "True"
