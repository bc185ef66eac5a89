"""Strict reading of TOML tables: values, defaults and error messages."""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from gelflow.errors import UsageError
from gelflow.toml_tables import TomlTable, read_toml, set_by_path, suggestion, toml_text

TABLE = TomlTable({"n": 3, "x": 0.5, "name": "left", "on": True, "sizes": [1, 2.5], "sub": {"k": 1}}, "file.toml")


@dataclass(frozen=True)
class Inner:
    """A nested table."""

    count: int
    size: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise UsageError(f"count must not be negative, got {self.count}")


@dataclass(frozen=True)
class Outer:
    """A table with a nested table."""

    name: str
    inner: Inner
    scale: float = 1.0
    on: bool = False


def test_written_values_are_read_back() -> None:
    tables = {
        "text": '\U0001f916 \u00e4 \x7f \n " \\ ',
        "key with a space": [1, 2.5, math.inf, True],
        "": 1e-300,
        "a.b": {"sub table": {"rows": [{"x y": -math.inf}, {"z": []}]}},
    }
    assert tomllib.loads(toml_text(tables)) == tables
    assert toml_text({"a": 0.5, "b": "\u00e4", "c": (1, 2)}) == 'a = 0.5\nb = "\\u00e4"\nc = [1, 2]\n'
    assert math.isnan(tomllib.loads(toml_text({"nan": math.nan}))["nan"])
    for value in (None, "\udc80", [None]):
        with pytest.raises(UsageError, match="a TOML file cannot contain"):
            toml_text({"a": value})


def test_values_are_converted() -> None:
    assert (TABLE.integer("n"), TABLE.number("n"), TABLE.number("x")) == (3, 3.0, 0.5)
    assert (TABLE.string("name"), TABLE.strings("name"), TABLE.boolean("on")) == ("left", ("left",), True)
    assert TABLE.numbers("sizes", 2) == (1.0, 2.5)
    assert TABLE.table("sub").integer("k") == 1 and not TABLE.table("none").data
    assert TABLE.number("none", 7.0) == 7.0


@pytest.mark.parametrize(
    ("method", "args", "message"),
    [
        ("number", ("none",), "file.toml: none is missing"),
        ("number", ("name",), "file.toml: name must be a finite number, got 'left'"),
        ("number", ("on",), "file.toml: on must be a finite number, got True"),
        ("integer", ("x",), "file.toml: x must be an integer ≥ 1, got 0.5"),
        ("string", ("n",), "file.toml: n must be a string, got 3"),
        ("boolean", ("n",), "file.toml: n must be true or false, got 3"),
        ("numbers", ("sizes", 3), "file.toml: sizes must be 3 finite numbers, got [1, 2.5]"),
        ("strings", ("n",), "file.toml: n must be a name or a list of names, got 3"),
        ("table", ("n",), "file.toml: n must be a table, got 3"),
    ],
)
def test_invalid_values_name_file_and_key(method: str, args: tuple[str | int, ...], message: str) -> None:
    with pytest.raises(UsageError) as error:
        getattr(TABLE, method)(*args)
    assert str(error.value) == message


def test_numbers_must_be_finite_and_above_the_minimum() -> None:
    for value in (float("nan"), float("inf"), float("-inf")):
        with pytest.raises(UsageError, match="k must be a finite number"):
            TomlTable({"k": value}, "f").number("k")
    with pytest.raises(UsageError, match="x must be a finite number ≥ 1, got"):
        TABLE.number("x", minimum=1)


def test_integers_beyond_a_float_are_no_finite_numbers() -> None:
    huge = TomlTable({"n": 10**400, "sizes": [1, 10**400]}, "file.toml")
    with pytest.raises(UsageError, match="n must be a finite number"):
        huge.number("n")
    with pytest.raises(UsageError, match="sizes must be 2 finite numbers"):
        huge.numbers("sizes", 2)


@pytest.mark.parametrize("text", ["n = 1" + 5000 * "0", "n = " + 3000 * "[" + 3000 * "]"], ids=["digits", "nested"])
def test_what_the_parser_cannot_hold_is_no_valid_toml(tmp_path: Path, text: str) -> None:
    (tmp_path / "odd.toml").write_text(text)
    with pytest.raises(UsageError, match="is not valid TOML"):
        read_toml(tmp_path / "odd.toml")


def test_unknown_and_renamed_keys() -> None:
    valid = ("n", "x", "names", "on", "sizes", "sub")
    with pytest.raises(UsageError, match="unknown key 'name'; did you mean 'names'"):
        TABLE.check_keys(valid)
    with pytest.raises(UsageError, match="unknown key 'name'; it is now called 'sizes'"):
        TABLE.check_keys(valid, renamed={"name": "sizes"})
    assert suggestion("zzz", ("b", "a")) == "valid names: a, b"


def test_dataclasses_are_read_from_tables() -> None:
    table = TomlTable({"name": "a", "inner": {"count": 0, "size": [3, 4]}, "on": True}, "f.toml")
    assert table.as_dataclass(Outer) == Outer("a", Inner(0, (3.0, 4.0)), 1.0, True)
    for data, message in (
        ({"inner": {"count": 1}}, "f.toml: name is missing"),
        ({"name": "a", "inner": {"count": 1}, "scael": 2}, "f.toml: unknown key 'scael'; did you mean 'scale'?"),
        ({"name": "a", "inner": {"count": 1.5}}, "f.toml, inner: count must be an integer, got 1.5"),
        ({"name": "a", "inner": {"count": -1}}, "f.toml, inner: count must not be negative, got -1"),
    ):
        with pytest.raises(UsageError) as error:
            TomlTable(data, "f.toml").as_dataclass(Outer)
        assert str(error.value) == message


def test_values_are_set_by_dotted_path() -> None:
    tables = {"pads": {"left": {"rows": 1}, "right": {"rows": 1}}}
    set_by_path(tables, "pads.*.rows", 2)
    set_by_path(tables, "pads.left.cols", 3)
    assert tables == {"pads": {"left": {"rows": 2, "cols": 3}, "right": {"rows": 2}}}
    with pytest.raises(UsageError, match="no table 'lft'; did you mean 'left'"):
        set_by_path(tables, "pads.lft.rows", 2)


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("n = 3\n", encoding="utf-8-sig")
    assert read_toml(tmp_path / "a.toml") == {"n": 3}


def test_unreadable_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file"):
        read_toml(tmp_path / "none.toml")
    with pytest.raises(UsageError, match="cannot read"):
        read_toml(tmp_path)
    (tmp_path / "bad.toml").write_text("a = = 1")
    with pytest.raises(UsageError, match="is not valid TOML"):
        read_toml(tmp_path / "bad.toml")
