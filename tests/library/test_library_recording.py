"""Recordings of the library: from files and tables, with warnings and errors that name the remedy."""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from golden import FOLDER

import upright

pandas = pytest.importorskip("pandas")
polars = pytest.importorskip("polars")
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


STAMPS = np.arange(20) / 100.0
ANGLES = np.sin(STAMPS)
DATES = pandas.Timestamp("2024-03-01 12:00") + pandas.to_timedelta(STAMPS, unit="s")
POLARS = polars.DataFrame({"time": list(DATES.to_pydatetime()), "angle": ANGLES})


def with_time(place: int, value: float) -> np.ndarray:
    return np.where(np.arange(20) == place, value, STAMPS)


class TestFrame:
    """A table in memory is read as one in a file is: what is assumed is said, and what cannot be used is refused."""

    @pytest.mark.parametrize(
        ("more", "says"),
        [
            ({"state": ["RUN"] * 20}, "state: text, left out"),
            ({"gain": 1j * ANGLES}, "gain: of type complex128, left out"),
            ({"armed": ANGLES > 0.1}, "armed: yes or no, read as 1 or 0"),
            ({"time": STAMPS[::-1], "angle": ANGLES[::-1]}, "the rows are in reverse"),
            ({"time": np.repeat(STAMPS, 2), "angle": np.repeat(ANGLES, 2)}, "20 rows are repeated and left out"),
            ({"time": with_time(5, 0.04)}, "1 time stamps are repeated"),
            ({"time": STAMPS - np.where(STAMPS > 0.145, 0.03, 0.0)}, "time: set back by 0.03 s in line 16"),
            ({"angle": np.degrees(ANGLES)}, "angle: deg, converted to rad"),
            ({"time": 1e3 * STAMPS}, "time: in ms, as stated"),
            ({"angle": [f"{each:.9f}" for each in ANGLES]}, "angle: text, read as numbers"),
        ],
    )
    def test_what_is_assumed_is_said(self, more: dict[str, object], says: str) -> None:
        stated = {"angle": "deg"} if "deg" in says else {"time": "ms"} if "ms" in says else {}
        found = upright.Recording.from_frame({"time": STAMPS, "angle": ANGLES, **more}, units=stated)
        assert says in "; ".join(found.assumed)
        np.testing.assert_allclose(found["angle"], ANGLES, atol=1e-8)
        assert found.rate == pytest.approx(100.0)

    @pytest.mark.parametrize("row", [0, 7])
    @pytest.mark.parametrize("unknown", [np.nan, np.inf])
    def test_rows_without_a_time_are_left_out(self, unknown: float, row: int) -> None:
        found = upright.Recording.from_frame({"time": with_time(row, unknown), "angle": ANGLES})
        np.testing.assert_array_equal(found["angle"], np.delete(ANGLES, row))
        assert f"1 row without a time left out, the first in line {row + 1}" in found.assumed

    @pytest.mark.parametrize(
        "angle",
        [
            np.where(np.arange(20) == 3, np.inf, ANGLES),
            np.ma.masked_array(ANGLES, np.arange(20) == 3),
            pandas.array(np.where(np.arange(20) == 3, np.nan, ANGLES), dtype="Float64"),
            [None if row == 3 else each for row, each in enumerate(ANGLES)],
            [pandas.NA if row == 3 else each for row, each in enumerate(ANGLES)],
            polars.Series([None if row == 3 else each for row, each in enumerate(ANGLES)]),
        ],
        ids=["infinite", "masked", "nullable", "None", "NA", "polars"],
    )
    def test_values_that_are_not_known_are_nan(self, angle: object) -> None:
        table = polars.DataFrame if isinstance(angle, polars.Series) else pandas.DataFrame
        found = upright.Recording.from_frame(table({"time": STAMPS, "angle": angle}))
        np.testing.assert_array_equal(found["angle"], np.where(np.arange(20) == 3, np.nan, ANGLES))

    @pytest.mark.parametrize(
        "frame",
        [
            pandas.DataFrame({"time": DATES, "angle": ANGLES}),
            pandas.DataFrame({"time": DATES.tz_localize("Europe/Berlin"), "angle": ANGLES}),
            pandas.DataFrame({"time": list(map(str, DATES)), "angle": ANGLES}),
            pandas.DataFrame({"time": DATES - DATES[0], "angle": ANGLES}),
            {"time": (1000 * STAMPS).round().astype("timedelta64[ms]"), "angle": ANGLES},
            {"time": DATES.to_pydatetime(), "angle": ANGLES},
            pandas.DataFrame({"angle": ANGLES}, index=DATES),
            pandas.DataFrame({"angle": ANGLES}, index=DATES - DATES[0]),
            pandas.DataFrame({"angle": ANGLES}, index=pandas.Index(STAMPS, name="time")),
            np.array(list(zip(STAMPS, ANGLES, strict=True)), dtype=[("time", float), ("angle", float)]),
            POLARS,
            POLARS.with_columns(polars.col("time").cast(polars.String)),
            POLARS.with_columns(polars.col("time") - polars.col("time").first()),
            POLARS.with_columns(polars.col("time").dt.replace_time_zone("Europe/Berlin")),
        ],
        ids=[
            "dates",
            "zone",
            "texts",
            "durations",
            "ms",
            "datetime",
            "index",
            "since",
            "named",
            "fields",
            "polars",
            "polars-texts",
            "polars-durations",
            "polars-zone",
        ],
    )
    def test_dates_durations_and_an_index_are_times(self, frame: object) -> None:
        found = upright.Recording.from_frame(frame)
        np.testing.assert_allclose(found.time, STAMPS, atol=1e-9)
        np.testing.assert_array_equal(found["angle"], ANGLES)

    @pytest.mark.parametrize(
        ("frame", "units", "message"),
        [
            ({"angle": ANGLES}, {}, "time: is missing; there are angle.*Name the column of seconds `time`"),
            ({"Time": STAMPS, "angle": ANGLES}, {}, "Is it 'Time'"),
            ({"time": STAMPS, "state": ["up"] * 20}, {}, "state: text.*Leave out columns that are not numbers"),
            ({"time": ["now"] * 20, "angle": ANGLES}, {}, "time: is not of numbers or dates.*Give seconds"),
            ({"time": np.nan * STAMPS, "angle": ANGLES}, {}, "time: is not a number in any row"),
            ({"time": np.ones(20), "angle": ANGLES}, {}, "time: is the same in all rows"),
            ({"time": 1.7e12 + 1e3 * STAMPS, "angle": ANGLES}, {}, r"no second of this century.*row 1.*\"ms\""),
            ({"time": STAMPS, "angle": ANGLES[:5]}, {}, "angle: has 5 values for 20 instants.*the same length"),
            ({"time": STAMPS, "angle": np.zeros((20, 2))}, {}, r"angle: has the shape \(20, 2\).*of its own"),
            ({"time": STAMPS, "angle": 1.0}, {}, r"angle: has the shape \(\)"),
            ({"time": STAMPS, "angle": [[1.0], [1.0, 2.0]]}, {}, "angle: is no column"),
            ({"time": STAMPS, 1: ANGLES, "1": ANGLES}, {}, "1: is a column twice.*name of its own"),
            ({"time": STAMPS, "angle": ANGLES}, {"angel": "rad"}, "angel: has a unit.*Is it 'angle'"),
            ({"time": STAMPS, "angle": ANGLES}, {"time": "V"}, "time: cannot be in V"),
            ({"time": [], "angle": []}, {}, "holds no rows"),
            ({}, {}, "time: is missing; there are no columns"),
            (np.zeros((3, 2)), {}, "is no table, but of type ndarray.*a mapping of names to arrays"),
            (None, {}, "is no table, but of type NoneType"),
            (POLARS.lazy(), {}, r"is a LazyFrame, which has no values yet.*Give frame.collect\(\)"),
        ],
    )
    def test_what_cannot_be_used_is_refused_with_the_remedy(
        self, frame: object, units: dict[str, str], message: str
    ) -> None:
        with pytest.raises(upright.UprightError, match=f"bench: .*{message}") as caught:
            upright.Recording.from_frame(frame, units=units, source="bench")
        assert caught.value.remedy

    def test_headings_are_names_and_not_read_for_units(self) -> None:
        found = upright.Recording.from_frame({"time": STAMPS, "angle_deg": ANGLES, "speed [rpm]": ANGLES})
        assert found.channels.names == ("angle_deg", "speed [rpm]")
        np.testing.assert_array_equal(found["speed [rpm]"], ANGLES)


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


@pytest.mark.parametrize("source", ["file", "frame"])
def test_question_in_python_is_answered_by_what_it_names(source: str, folder: Path, tmp_path: Path) -> None:
    plain, table = upright.load(folder / "run.csv"), tmp_path / "degrees.csv"
    frame = plain.to_frame().assign(angle=np.degrees(plain["angle"]))
    frame.to_csv(table, index=False)

    def read(**more: Any) -> upright.Recording:
        return upright.load(table, **more) if source == "file" else upright.Recording.from_frame(frame, **more)

    found = upright.diagnose(read(), model=folder / "pendulum.toml", effects="viscous_friction")
    assert found.verdict == "insufficient_data"
    words = 'read it with assume={"angle": "deg"}; if it is right as it is, with assume={"angle": "1"}.'
    assert words in found.reason
    assert "--" not in str(found)
    assert read(assume={"angle": "1"}).settled >= {"angle"}
    right = read(assume={"angle": "deg"})
    np.testing.assert_allclose(right["angle"], plain["angle"], atol=1e-9)
    assert upright.diagnose(right, model=folder / "pendulum.toml", effects="viscous_friction").verdict != found.verdict
