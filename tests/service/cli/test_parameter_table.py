"""The table of estimated parameters on a narrow terminal."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from upright.service.output import live_estimates, parameter_table

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
    output = page.file.getvalue()
    for text in (" 1612 ", "46", "kg m^2", "2.9 %", " -50 ", "40 %", "static_torque.torque", "drive_time_offset"):
        assert text in output
    assert "…" not in output
    letters = "".join(line[:32].split("  ")[0].strip() for line in output.splitlines() if line and line[0] != " ")
    assert "recursive_instrumental_variables" in letters


def printed(estimates: dict[str, Any]) -> str:
    page = Console(file=io.StringIO(), width=60)
    page.print(parameter_table(estimates))
    assert isinstance(page.file, io.StringIO)
    return " ".join(page.file.getvalue().split())


def test_reason_is_printed_in_full_and_only_once() -> None:
    output = printed(ESTIMATES)
    assert output.endswith("drive_time_offset: the record does not tell it")
    (one,) = ESTIMATES.values()
    assert printed({"a": {**one, "reason": "the record does not tell it"}}).count("the record does not tell it") == 1


def test_reasons_name_the_method_if_there_are_several() -> None:
    (one,) = ESTIMATES.values()
    failed = {"parameters": {}, "reason": "ValueError: [no] number"}
    output = printed({"a": one, "b": one, "c": failed})
    assert "drive_time_offset (a), drive_time_offset (b): the record does not tell it" in output
    assert "c: ValueError: [no] number" in output


def test_live_estimates_end_with_where_methods_part() -> None:
    (one,) = ESTIMATES.values()
    other = {**one, "parameters": {"inertia": {"value": 1800.0, "std": 10.0, "unit": "kg m^2"}}}
    page = Console(file=io.StringIO(), width=200)
    page.print(live_estimates({"a": one, "b": other}))
    assert isinstance(page.file, io.StringIO)
    last = page.file.getvalue().splitlines()[-1].strip()
    assert last == "methods part inertia: a and b part, by 4.0 standard deviations of their difference"
    page.print(live_estimates({"a": one}))
    assert page.file.getvalue().count("methods part") == 1
