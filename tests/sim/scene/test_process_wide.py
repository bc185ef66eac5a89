"""The working directory does not change which scene is loaded, and loading changes nothing of the process."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import mujoco
import pytest

from gelflow.sim.scene import load_scene


def test_file_in_the_working_directory_does_not_replace_a_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grasp").write_text("run 1: 87 %")
    assert load_scene("grasp").pads


def test_warning_handler_of_the_process_is_kept() -> None:
    before = mujoco.get_mju_user_warning()
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(load_scene, ["rolling"] * 40))
    assert mujoco.get_mju_user_warning() is before
