"""Gel files."""

from pathlib import Path

import pytest

from gelflow.errors import UsageError
from gelflow.gel.gel_file import ElasticGel, load_gel, save_gel

TEXT = """
format = 1
[gel]
youngs_modulus = 1.5e5
poisson_ratio = 0.48
thickness = 0.003
"""


def test_a_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "gel.toml").write_text(TEXT + "youngs_modulus_deviation = 0.1\n")
    assert load_gel(tmp_path / "gel.toml") == ElasticGel(1.5e5, 0.48, 0.003, 0.1)


def test_a_file_name_may_be_text(tmp_path: Path) -> None:
    gel, name = ElasticGel(1.5e5, 0.48, 0.003), str(tmp_path / "new.toml")
    save_gel(gel, name)
    assert load_gel(name) == gel


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("format = 1", "format = 9", "format 9"),
        ("0.003", "3.0", "metres"),
        ("0.48", "0.6", "poisson_ratio"),
        ("1.5e5", "0.0", "youngs_modulus"),
        ("1.5e5", "inf", "youngs_modulus"),
        ("thickness", "thicknes", "thickness"),
        ("[gel]", "[gell]", "gel"),
        ("thickness = 0.003", "", "thickness"),
    ],
)
def test_wrong_files_are_refused(old: str, new: str, named: str, tmp_path: Path) -> None:
    (tmp_path / "gel.toml").write_text(TEXT.replace(old, new))
    with pytest.raises(UsageError, match=named):
        load_gel(tmp_path / "gel.toml")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"gel\.toml"):
        load_gel(tmp_path / "gel.toml")
