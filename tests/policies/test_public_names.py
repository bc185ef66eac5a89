"""The public names of gelflow.policies."""

import subprocess
import sys

import gelflow.policies as policies


def test_every_public_name_is_listed_and_resolves() -> None:
    expected = {"load_policy", "load_network", "recipe_for", "load_checkpoint", "Network", "train", "evaluate_task"}
    assert expected <= set(policies.__all__) <= set(dir(policies))
    assert [name for name in policies.__all__ if not hasattr(policies, name)] == []


def test_importing_the_package_imports_no_heavy_dependency() -> None:
    heavy = ("torch", "cv2", "mujoco", "matplotlib", "scipy", "gymnasium", "gelflow.sim._core")
    code = f"import sys, gelflow.policies; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_loading_a_policy_needs_neither_torch_nor_the_simulator() -> None:
    code = (
        "import sys; from gelflow.policies import default_checkpoint, load_policy; load_policy(default_checkpoint())\n"
        "print([name for name in ('torch', 'gymnasium', 'mujoco', 'gelflow.sim._core') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
