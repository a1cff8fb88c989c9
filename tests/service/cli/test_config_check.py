"""`upright config check` opens the data sheet of each drive."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from upright.drivers.cia402.config import SHIPPED_EDS
from upright.drivers.cia402.eds import EdsError
from upright.service.cli import app
from upright.vehicles.file import shipped_file

SHEET = (SHIPPED_EDS / "upright_servo.eds").read_text()


def checked(folder: Path, old: str, new: str, *options: str) -> Result:
    """The result of the check of a MONOCAB whose first drive has this sheet with one text replaced."""
    assert old in SHEET
    (folder / "makers.eds").write_text(SHEET.replace(old, new))
    file = folder / "mine.toml"
    file.write_text(shipped_file("monocab").read_text().replace('"upright_servo.eds"', '"makers.eds"', 1))
    return CliRunner().invoke(app, ["config", "check", str(file), *options])


def test_harmless_fault_of_a_data_sheet_is_a_note(tmp_path: Path) -> None:
    result = checked(tmp_path, "VendorNumber=0x00555052", "VendorNumber=0x")
    assert result.exit_code == 0
    said = "[DeviceInfo] VendorNumber: '0x' is no number: left out"
    assert f"eds of drive gimbal_left: {said}" in result.output
    result = checked(tmp_path, "VendorNumber=0x00555052", "VendorNumber=0x", "--json")
    found = json.loads(result.stdout)["eds"]
    assert found == {"gimbal_left": [said], "gimbal_right": [], "trim": []}


def test_data_sheet_of_another_drive_is_refused_with_section_and_key(tmp_path: Path) -> None:
    old = "[6042]\nParameterName=vl target velocity\nObjectType=0x7\nDataType=0x0003"
    result = checked(tmp_path, old, old.replace("0x0003", "0x0004"))
    assert result.exit_code == 1
    with pytest.raises(EdsError, match=r"makers\.eds.*\[6042\] DataType: .*INTEGER32, not INTEGER16.*Remedy: Name"):
        raise result.exception
