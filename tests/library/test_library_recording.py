"""Recordings of the library: from files and tables, with warnings and errors that name the remedy."""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from golden import FOLDER

import upright

pandas = pytest.importorskip("pandas")
GOLDEN = FOLDER / "monocab-multisine-seed1-10s.parquet"


def test_a_recording_is_read_and_shown_in_one_line(folder: Path) -> None:
    recording = upright.load(folder / "run.csv")
    assert isinstance(recording, upright.Recording)
    assert str(recording).endswith("run.csv: 15 s, 3000 samples at 200 Hz; voltage, angle")
    assert recording["angle"].shape == recording.time.shape == (3000,)


def test_a_part_is_read(folder: Path) -> None:
    part = upright.load(folder / "run.csv", begin=2.0, end=5.0)
    assert part.duration == pytest.approx(3.0)
    assert isinstance(part, upright.Recording)


def test_the_user_says_what_a_table_does_not(folder: Path, tmp_path: Path) -> None:
    plain = upright.load(folder / "run.csv")
    table = tmp_path / "other.csv"
    columns = np.column_stack((1e3 * plain.time, plain["voltage"] * 255.0 / 12.0, np.degrees(plain["angle"])))
    np.savetxt(table, columns, fmt="%.9g", delimiter=",", header="tick,u,pos", comments="")
    said = {"columns": {"time": "tick:ms", "angle": "pos:deg", "voltage": "u"}, "assume": {"voltage": "12/255"}}
    found = upright.load(table, model=folder / "pendulum.toml", **said)
    np.testing.assert_allclose(found["angle"], plain["angle"], atol=1e-7)
    np.testing.assert_allclose(found["voltage"], plain["voltage"], atol=1e-6)
    assert found.settled == {"time", "angle", "voltage"}  # so no question is asked about them
    assert any("angle" in each for each in found.assumed)
    written = tmp_path / "mapped.toml"
    text = (folder / "pendulum.toml").read_text()
    written.write_text(text + '\n[columns]\ntime = "tick:ms"\nangle = "pos:deg"\nvoltage = "u:0.0470588235"\n')
    np.testing.assert_allclose(upright.load(table, model=written)["voltage"], plain["voltage"], atol=1e-6)


DBC = """VERSION ""
BU_: ECU
BO_ 256 Arm: 8 ECU
 SG_ Position : 0|32@1- (0.0001,0) [-100|100] "deg" ECU
 SG_ Command : 32|32@1- (0.0001,0) [-100|100] "V" ECU
"""


class TestDbc:
    """A CAN log of any machine, by the file that says what its signals are."""

    @pytest.fixture
    def log(self, tmp_path: Path) -> Path:
        """Five samples 10 ms apart: 1 to 5 degrees, 6 to 10 V."""
        frames = [
            f"({1_700_000_000 + row / 100:.6f}) can0 100#{struct.pack('<ii', 10_000 * row, 10_000 * (row + 5)).hex()}\n"
            for row in range(1, 6)
        ]
        (tmp_path / "arm.dbc").write_text(DBC)
        (tmp_path / "run.log").write_text("".join(frames))
        return tmp_path / "run.log"

    def test_signals_are_channels_in_si(self, log: Path) -> None:
        found = upright.load(log, dbc=log.with_name("arm.dbc"))
        assert isinstance(found, upright.Recording)
        assert {each.name: each.unit for each in found.channels} == {"Position": "rad", "Command": "V"}
        np.testing.assert_allclose(found["Position"], np.radians([1.0, 2.0, 3.0, 4.0, 5.0]))
        assert found.rate == pytest.approx(100.0)

    @pytest.mark.parametrize("model", [True, False])
    @pytest.mark.parametrize("vehicle", [None, "monocab"])
    def test_signals_are_named_as_the_columns_of_a_table_are(
        self, vehicle: str | None, model: bool, log: Path, folder: Path
    ) -> None:
        found = upright.load(
            log,
            vehicle=vehicle,
            model=folder / "pendulum.toml" if model else None,
            dbc=str(log.with_name("arm.dbc")),
            columns={"angle": "Position", "voltage": "Command"},
            assume={"voltage": "-1"},
        )
        np.testing.assert_allclose(found["angle"], np.radians([1.0, 2.0, 3.0, 4.0, 5.0]))
        np.testing.assert_allclose(found["voltage"], [-6.0, -7.0, -8.0, -9.0, -10.0])
        assert "angle: column 'Position'" in found.assumed

    def test_log_without_a_dbc_and_a_table_with_one_are_refused(self, log: Path, folder: Path) -> None:
        with pytest.raises(upright.UprightError, match="or a DBC that names their signals"):
            upright.load(log)
        with pytest.raises(upright.UprightError, match="Leave the DBC out"):
            upright.load(folder / "run.csv", dbc=log.with_name("arm.dbc"))
        with pytest.raises(upright.UprightError, match="No such file"):
            upright.load(log, dbc=log.with_name("other.dbc"))
        with pytest.raises(upright.UprightError, match="Check the path"):
            upright.load(log.with_name("none.csv"), dbc=log.with_name("arm.dbc"))


def test_what_is_unusual_is_a_warning(tmp_path: Path) -> None:
    cut = tmp_path / "cut.csv"
    cut.write_text("time,angle\n0.0,1.0\n0.1,2.0\n0.2,2.5\n0.3")
    with pytest.warns(upright.RecordingWarning, match="line 5 is cut off") as caught:
        upright.load(cut)
    assert caught[0].filename == __file__


def test_a_missing_file_and_a_raw_log_without_a_vehicle_name_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(upright.UprightError, match="Remedy: Check the path"):
        upright.load(tmp_path / "none.csv")
    with pytest.raises(upright.UprightError, match="Remedy: Name the vehicle"):
        upright.load(tmp_path / "run.log")


def test_a_table_becomes_a_recording_and_a_table_again(folder: Path) -> None:
    table = upright.load(folder / "run.csv").to_frame()
    assert list(table.columns) == ["time", "voltage", "angle"]
    back = upright.Recording.from_frame(table, units={"angle": "rad"}, source="bench")
    assert back.source == "bench"
    assert back.channels[back.channels.index_of("angle")].unit == "rad"
    np.testing.assert_array_equal(back["angle"], table["angle"])
    assert back.rate == pytest.approx(200.0)


def test_a_mapping_of_arrays_becomes_a_recording() -> None:
    recording = upright.Recording.from_frame({"time": np.arange(10) / 100.0, "angle": list(range(10))})
    assert recording.rate == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"angle": [1.0, 2.0]}, "Name the column of seconds `time`"),
        ({"time": [0.0, 0.1], "state": ["up", "down"]}, "Leave out columns that are not numbers"),
        ({"time": [0.1, 0.0], "angle": [1.0, 2.0]}, "Sort the rows by time"),
        ({"time": [0.0, 0.1], "angle": [1.0]}, "Give every column the same length"),
    ],
)
def test_a_table_that_cannot_be_used_names_the_remedy(columns: dict[str, list[object]], message: str) -> None:
    with pytest.raises(upright.UprightError, match=message):
        upright.Recording.from_frame(columns)


def test_without_pandas_the_error_names_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = upright.load(folder / "run.csv")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(upright.UprightError, match=r"pip install 'upright\[pandas\]'"):
        recording.to_frame()


def test_plot_shows_the_channels_that_change_and_a_notebook_gets_a_picture() -> None:
    recording = upright.load(GOLDEN)
    picture = recording.plot()
    named = {axes.get_ylabel().split("\n")[0] for axes in picture.axes}
    assert {"roll", "precession_rate"} <= named
    assert "setpoint_age" not in named
    assert len(recording.plot("roll").axes) == 1
    assert recording.plot("roll")._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(upright.UprightError, match="'roll'"):
        recording.plot("rol")


class TestVehicle:
    """Which vehicle made a recording, where nobody says so."""

    def test_it_is_the_shipped_one_that_the_recording_names(self) -> None:
        compared = upright.compare(upright.load(GOLDEN))
        assert list(compared.adequate) == ["CAD"]

    def test_a_recording_without_one_needs_a_model(self, folder: Path) -> None:
        with pytest.raises(upright.UprightError, match="give a model, or the vehicle"):
            upright.compare(upright.load(folder / "run.csv"))

    def test_one_with_a_file_of_its_own_has_to_be_given(self) -> None:
        other = replace(upright.load(GOLDEN), metadata={"kind": "monocab", "vehicle": "number seven"})
        with pytest.raises(upright.UprightError, match="number seven, which has a file of its own"):
            upright.identify(other)

    def test_recordings_of_two_are_refused_together(self) -> None:
        one, other = upright.load(GOLDEN), upright.load(FOLDER / "twsbr-square-seed1.parquet")
        with pytest.raises(upright.UprightError, match="of one vehicle together"):
            upright.diagnose([one, other])
