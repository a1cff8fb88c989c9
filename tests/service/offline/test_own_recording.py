"""A stranger's table on the command line: read as it is, asked about, or refused with the remedy."""

from __future__ import annotations

import csv
import html
import json
import math
import re
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pendulum_plant
import pyarrow as pa
import pytest
from pyarrow import feather
from typer.testing import CliRunner
from virtual_records import multisine

import upright as library
from upright.service.cli import app
from upright.service.offline.export import export
from upright.telemetry.candump import format_frames
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.telemetry.samples import CanFrame
from upright.telemetry.storage import load, load_all, save

MANUAL = Path(__file__).resolve().parents[3] / "docs" / "how-to" / "write-your-own-model.md"
QUICK = ("--method", "prediction_error")
Rows = list[list[str]]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first model file of the manual."""
    path = tmp_path_factory.mktemp("own") / "pendulum.toml"
    path.write_text(re.findall(r"^```toml\n(.*?)^```", MANUAL.read_text(), re.DOTALL | re.MULTILINE)[0])
    return path


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    """The pendulum's table, 20 s, with its header."""
    path = pendulum_plant.write(tmp_path_factory.mktemp("run") / "run.csv", seed=72, duration=20.0)
    return [line.split(",") for line in path.read_text().splitlines()]


def table(path: Path, rows: Rows, header: Sequence[str] | None = None, separator: str = ",", **columns: Any) -> Path:
    """The table at `path`, with another `header`; `columns` make another number of each of a channel."""
    change: list[Callable[[float], float]] = [columns.get(name, lambda value: value) for name in rows[0]]
    lines = [separator.join(header or rows[0])]
    for row in rows[1:]:
        fields = (f"{make(float(text)):.9g}" for make, text in zip(change, row, strict=True))
        lines.append(separator.join(fields).replace(".", "," if separator == ";" else "."))
    path.write_text("\n".join(lines) + "\n")
    return path


def upright(*arguments: Any, code: int = 0) -> Any:
    """The JSON document of a command."""
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return json.loads(done.stdout)


def inertia(document: Any) -> float:
    found = document["methods"]["prediction_error"]["parameters"]["inertia"]["value"]
    assert isinstance(found, float)
    return found


def test_table_with_other_names_and_units_gives_the_same_estimates(model: Path, rows: Rows, tmp_path: Path) -> None:
    plain = upright("identify", table(tmp_path / "run.csv", rows), "--model", model, *QUICK)
    header = ("Zeit [ms]", "Voltage (mV)", "pos")
    milli = {"time": lambda t: 1e3 * t, "voltage": lambda u: 1e3 * u, "angle": np.degrees}
    other = table(tmp_path / "log.txt", rows, header, ";", **milli)
    read = upright("identify", other, "--model", model, *QUICK, "--map", "angle=pos:deg")
    assert inertia(read) == pytest.approx(inertia(plain), rel=1e-4)
    assert inertia(plain) == pytest.approx(pendulum_plant.INERTIA, rel=0.02)
    said = "; ".join(read["assumed"]["log.txt"])
    for part in (
        "semicolon",
        "decimal mark: comma",
        "column Zeit [ms], in ms",
        "voltage: mV, converted to V",
        "in deg",
    ):
        assert part in said


def test_columns_of_the_model_file_name_what_is_what(model: Path, rows: Rows, tmp_path: Path) -> None:
    other = tmp_path / "columns.toml"
    columns = '[columns]\nangle = "/joint_states/joint1/position:deg"\nvoltage = "u"\n\n[parameters]'
    other.write_text(model.read_text().replace("[parameters]", columns, 1))
    path = table(tmp_path / "run.csv", rows, ("t", "u", "/joint_states/joint1/position"), angle=np.degrees)
    assert inertia(upright("identify", path, "--model", other, *QUICK)) == pytest.approx(
        pendulum_plant.INERTIA, rel=0.02
    )


POSITION, VOLTAGE = "/joint_states/joint1/position", "Motor #1: u=cmd, 'raw' [V]"
"""Names that no equation can contain, and that options, tables and pages have to leave as they are."""


@pytest.mark.parametrize("suffix", [".csv", ".arrow", ".mf4"])
def test_columns_may_have_any_name_from_identification_to_report(
    suffix: str, model: Path, rows: Rows, tmp_path: Path
) -> None:
    """In the model file, in the options, and in the library."""
    values = np.array(rows[1:], dtype=np.float64)
    names = dict(zip(("time", VOLTAGE, POSITION), values.T, strict=True))
    path, named, page = tmp_path / f"run{suffix}", tmp_path / "named.toml", tmp_path / "page.html"
    if suffix == ".csv":
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([list(names), *values.tolist()])
    elif suffix == ".arrow":
        feather.write_feather(pa.table(names), path)
    else:
        export(library.Recording.from_frame(names, units={POSITION: "rad", VOLTAGE: "V"}), path)
    columns = f'[columns]\nangle = "{POSITION}"\nvoltage = "{VOLTAGE}"\n\n[parameters]'
    named.write_text(model.read_text().replace("[parameters]", columns, 1))
    by_map = ("--map", f"angle={POSITION}", "--map", f"voltage={VOLTAGE}")
    assert library.load(path, model=named)["angle"] == pytest.approx(names[POSITION], abs=1e-6)
    for ways in (("--model", named), ("--model", model, *by_map)):
        assert inertia(upright("identify", path, *ways, *QUICK)) == pytest.approx(pendulum_plant.INERTIA, rel=0.02)
    if suffix != ".csv":
        return  # from here on, the recording is the same
    compared = upright("compare", path, "--model", named, "--report", page)
    assert compared["models"][0]["fit_percent"].keys() == {"angle"}
    assert all(name in html.unescape(page.read_text()) for name in (POSITION, VOLTAGE))
    found = upright("diagnose", path, "--model", named, "--effect", "viscous_friction", "--report", page)
    assert found["verdict"] in ("adequate", "missing_effect", "unknown")
    assert POSITION in html.unescape(page.read_text())


DBC = """VERSION ""
NS_ :
BS_:
BU_: ECU
BO_ 256 Arm: 8 ECU
 SG_ Position : 0|32@1- (0.0001,0) [-100|100] "deg" ECU
 SG_ Command : 32|32@1- (0.0001,0) [-100|100] "V" ECU
"""


def test_signals_of_a_can_log_are_channels_of_a_model(model: Path, rows: Rows, tmp_path: Path) -> None:
    """By a DBC and `--map`, without converting the log first."""
    database, log = tmp_path / "arm.dbc", tmp_path / "run.log"
    database.write_text(DBC)
    frames = []
    for time, voltage, angle in np.array(rows[1:], dtype=np.float64):
        data = struct.pack("<ii", round(1e4 * math.degrees(angle)), round(1e4 * voltage))
        frames.append(CanFrame(1_700_000_000_000_000_000 + round(1e9 * time), 0x100, data))
    log.write_text(format_frames(frames, ("can0",)))
    ways = ("--model", model, "--dbc", database, "--map", "angle=Position", "--map", "voltage=Command")
    assert inertia(upright("identify", log, *ways, *QUICK)) == pytest.approx(pendulum_plant.INERTIA, rel=0.02)
    compared = upright("compare", log, *ways)["models"][0]
    assert compared["fit_percent"].keys() == {"angle"}
    found = upright("diagnose", log, *ways, "--effect", "viscous_friction")
    assert found["verdict"] in ("adequate", "missing_effect", "unknown")
    unnamed = upright("identify", log, *ways[:4], *QUICK, code=1)
    assert "channel" in unnamed["methods"]["prediction_error"]["reason"]


def test_angle_in_degrees_is_a_question_and_no_effect(model: Path, rows: Rows, tmp_path: Path) -> None:
    path = table(tmp_path / "run.csv", rows, angle=np.degrees)
    found = upright("diagnose", path, "--model", model, code=1)
    assert (found["verdict"], found["findings"]) == ("insufficient_data", [])
    assert "angle in degrees" in found["reason"]
    assert "--assume angle=deg" in found["reason"]
    for command in ("identify", "compare"):
        with pytest.raises(UprightError, match="angle in degrees") as caught:
            upright(command, path, "--model", model)
        assert "--assume angle=deg" in caught.value.remedy
    mended = upright("identify", path, "--model", model, *QUICK, "--assume", "angle=deg")
    assert inertia(mended) == pytest.approx(pendulum_plant.INERTIA, rel=0.02)
    assert "angle: in deg, as stated" in "; ".join(mended["assumed"]["run.csv"])


def test_report_has_what_was_assumed(model: Path, rows: Rows, tmp_path: Path) -> None:
    path, page = table(tmp_path / "run.csv", rows, ("t", "Voltage", "angle")), tmp_path / "page.html"
    upright("compare", path, "--model", model, "--report", page, "--from", 2, "--to", 12)
    assert "voltage: column &#39;Voltage&#39;" in page.read_text()


def test_part_of_a_recording_is_compared_and_identified(model: Path, rows: Rows, tmp_path: Path) -> None:
    path = table(tmp_path / "run.csv", rows, angle=lambda a: a)
    whole = upright("compare", path, "--model", model)["models"][0]
    part = upright("compare", path, "--model", model, "--from", 5, "--to", 15)["models"][0]
    assert part["rmse"]["angle"] != whole["rmse"]["angle"]
    values = [inertia(upright("identify", path, "--model", model, *QUICK, *limits)) for limits in ((), ("--to", 8))]
    assert values[0] != values[1]


@pytest.mark.parametrize("command", ["identify", "compare", "diagnose"])
def test_table_of_another_machine_is_not_judged_as_a_vehicle(command: str, rows: Rows, tmp_path: Path) -> None:
    path = table(tmp_path / "run.csv", rows)
    with pytest.raises(UprightError, match="has no channel of a monocab; there are voltage, angle") as caught:
        upright(command, path)
    for option in ("--model", "--vehicle", "--map roll=COLUMN"):
        assert option in caught.value.remedy


def test_recording_of_another_kind_of_vehicle_is_refused(tmp_path: Path) -> None:
    save(multisine().between(0.0, 1.0), tmp_path / "run.arrow")
    with pytest.raises(UprightError, match="is a recording of a monocab, not of ") as caught:
        upright("diagnose", tmp_path / "run.arrow", "--vehicle", "twsbr")
    assert "--vehicle monocab" in caught.value.remedy


def without_trim(path: Path) -> Recording:
    """A table of a MONOCAB whose trim mass is fixed."""
    whole = multisine().between(0.0, 12.0)
    names = ("roll", "roll_rate", "precession", "precession_rate", "precession_rate_setpoint")
    columns = [whole.time, *(whole[name] for name in names)]
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=f"time,{','.join(names)}", comments="")
    return whole


def test_monocab_without_trim_channels_has_a_trim_mass_at_rest(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    without_trim(path)
    found = upright("identify", path, "--method", "least_squares")
    assert found["methods"]["least_squares"]["status"] == "ok"
    assert "trim mass is at rest" in "; ".join(found["assumed"]["run.csv"])


def test_model_that_cannot_be_fitted_is_no_success(model: Path, rows: Rows, tmp_path: Path) -> None:
    path = table(tmp_path / "run.csv", rows, time=lambda t: 1e3 * t)
    found = upright("diagnose", path, "--model", model, "--assume", "time=s", code=1)
    assert found["findings"] == []


def test_file_of_a_logger_that_began_anew_is_converted_into_two(rows: Rows, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("\n".join(",".join(row) for row in [*rows[:1001], *rows[1:501]]) + "\n")
    done = CliRunner().invoke(app, ["convert", str(path), str(tmp_path / "run.parquet")], catch_exceptions=False)
    assert done.exit_code == 0
    assert len(load_all(path)) == 2
    assert [len(load(tmp_path / name)) for name in ("run.parquet", "run-2.parquet")] == [1000, 500]
