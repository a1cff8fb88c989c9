"""The table of estimated parameters on a narrow terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from service.cli.output import parameter_table

ESTIMATES = {
    "recursive_instrumental_variables": {
        "parameters": {
            "inertia": {"value": 1612.3, "std": 46.1, "unit": "kg m^2"},
            "static_torque.torque": {"value": -50.1, "std": 20.0, "unit": "N m"},
            "drive_time_offset": {"value": None, "std": None, "unit": "s", "reason": "the record does not tell it"},
        },
        "reason": "",
    }
}


@pytest.mark.parametrize("width", [80, 120])
def test_no_number_unit_or_name_is_cut(width: int) -> None:
    page = Console(file=io.StringIO(), width=width)
    page.print(parameter_table(ESTIMATES))
    assert isinstance(page.file, io.StringIO)
    said = page.file.getvalue()
    for text in ("1612.3", "46", "kg m^2", "2.9 %", "-50.1", "40 %", "static_torque.torque", "drive_time_offset"):
        assert text in said
    assert "…" not in said
    letters = "".join(line[:32].split("  ")[0] for line in said.splitlines() if line and line[0] != " ")
    assert "recursive_instrumental_variables" in letters
    assert "does" in said


def test_a_note_is_wrapped_and_not_lost() -> None:
    page = Console(file=io.StringIO(), width=80)
    page.print(parameter_table(ESTIMATES))
    assert isinstance(page.file, io.StringIO)
    words = page.file.getvalue().split()
    assert all(word in words for word in ("record", "does", "not", "tell"))
