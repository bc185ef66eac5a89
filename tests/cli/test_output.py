"""Text output of the commands."""

import pytest
from rich.table import Table

from gelflow.cli.insertion_text import insertion_table, preflight_table
from gelflow.cli.output import Output
from gelflow.real.runner.preflight import PreflightItem


def test_square_brackets_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table("depth [mm]", title="Contacts [N]")
    table.add_row("run[1].mcap")
    output = Output(width=60)
    output.console.print(insertion_table([]))
    output.console.print(table)
    output.text("monday[s].mcap")
    printed = capsys.readouterr().out
    for text in ("time [s]", "depth [mm]", "Contacts [N]", "run[1].mcap", "monday[s].mcap"):
        assert text in printed


def test_the_colons_of_an_address_are_no_emoji(capsys: pytest.CaptureFixture[str]) -> None:
    output = Output(width=60)
    output.text("open http://[fd00:a:b::5]:8080 in a browser")
    table = Table("address")
    table.add_row("tcp:[fd00:a:b::6]:1000")
    output.console.print(table)
    printed = capsys.readouterr().out
    assert "http://[fd00:a:b::5]:8080" in printed and "tcp:[fd00:a:b::6]:1000" in printed


def test_checks_are_a_table_of_ok_and_no(capsys: pytest.CaptureFixture[str]) -> None:
    Output(width=60).console.print(
        preflight_table([PreflightItem("arm", True, "EGM"), PreflightItem("[left]", False, "none")])
    )
    printed = capsys.readouterr().out
    assert "ok arm" in " ".join(printed.split()) and "no [left] none" in " ".join(printed.split())
