"""What is not clear in a table is refused with the remedy, or is left out and said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dialects import (
    ANGLE,
    BASE,
    COUNT,
    HEADER,
    RATE,
    RATES,
    ROWS,
    TIME,
    WANTED,
    columns,
    commas,
    extra,
    headed,
    lines,
    parquet,
    sparse,
    text,
    timed,
)

from upright.telemetry.errors import RecordingError
from upright.telemetry.storage import load, load_all
from upright.telemetry.tables.mapping import MappingError, said_of
from upright.telemetry.tables.wanted import Wanted

REFUSED = (
    ("decimal commas between commas", text(lines([HEADER, *commas()])), "3 headings for 6 columns", "semicolons"),
    ("no time", headed("voltage", "angle", rows=[row[1:] for row in ROWS]), "time: is missing", "--map time="),
    (
        "time does not rise",
        headed(*HEADER, rows=[(row[1], *row[1:]) for row in ROWS]),
        "no column of time",
        "--map time=",
    ),
    ("one column", text([line.split(",")[2] for line in BASE]), "one column only", "column of time"),
    ("a header alone", text(BASE[:1]), "holds no rows", "Record again"),
    ("nothing", b"", "holds no rows", "Record again"),
    (
        "words",
        text(["Dear all,", "please find attached, as ever,", "the recording."]),
        "no columns of numbers",
        "a column of time",
    ),
    ("workbook", b"PK\x03\x04" + bytes(100), "Excel workbook", "as CSV"),
    ("compressed", b"\x1f\x8b" + bytes(100), "compressed", "gunzip"),
    ("noise", np.random.default_rng(1).bytes(4096), "is not text", "UTF-8"),
    (
        "two columns of one name",
        headed("time", "voltage", "angle", "angle", rows=[(*row, row[1]) for row in ROWS]),
        "occurs twice",
        "--map angle=",
    ),
    (
        "two columns that may be it",
        headed("time", "voltage", "Angle", "ANGLE", rows=[(*row, row[1]) for row in ROWS]),
        "may be any of Angle, ANGLE",
        "--map angle=",
    ),
    ("another quantity", headed("time", "voltage [A]", "angle"), "in A in the file, and in V", "--map voltage="),
)


@pytest.mark.parametrize(("name", "content", "what", "remedy"), REFUSED, ids=[each[0] for each in REFUSED])
def test_table_that_is_not_clear_is_refused_with_the_remedy(
    name: str, content: bytes, what: str, remedy: str, tmp_path: Path
) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=what) as caught:
        load(path, WANTED)
    assert remedy in caught.value.remedy


@pytest.mark.parametrize(
    ("maps", "assumes", "what", "remedy"),
    [
        (("angle",), (), "names no channel or no column", "--map angle=pos:deg"),
        (("angle=pos:foo",), (), "no unit that is known", "deg"),
        ((), ("angle",), "names no channel or no unit", "--assume angle=deg"),
        ((), ("angle=furlong",), "no unit that is known", "wrapped"),
        ((), ("angle=wrapped:x",), "no period", "wrapped:4096"),
    ],
)
def test_option_that_cannot_be_understood_is_refused(
    maps: tuple[str, ...], assumes: tuple[str, ...], what: str, remedy: str
) -> None:
    with pytest.raises(MappingError, match=what) as caught:
        said_of(maps, assumes)
    assert remedy in caught.value.remedy


def test_column_that_is_not_there_is_named_with_those_that_are(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_bytes(text(BASE))
    with pytest.raises(RecordingError, match="no column 'angel'; there are voltage, angle") as caught:
        load(tmp_path / "run.csv", WANTED, said_of(("angle=angel",), ()))
    assert "'angle'" in caught.value.remedy


def test_logger_that_began_anew_wrote_two_recordings(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(text([*BASE[:401], *BASE[1:201]]))
    first, second = load_all(path, WANTED)
    assert (len(first), len(second)) == (400, 200)
    np.testing.assert_array_equal(second["angle"], ANGLE[:200])
    assert "line 402" in "; ".join(first.assumed)
    assert second.source.endswith("(part 2 of 2)")
    longest = load(path, WANTED)
    assert len(longest) == 400
    assert "there are 2 recordings" in longest.assumed[-1]


@pytest.mark.parametrize("late", [0.2, 0.205], ids=["the same stamps", "stamps in between"])
def test_clock_that_is_set_back_by_a_few_rows_is_not_taken_for_disorder(late: float, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(timed(lambda i: f"{TIME[i] - (late if i >= 300 else 0.0):.4f}"))
    found = load(path, WANTED)
    np.testing.assert_array_equal(found["angle"], ANGLE)
    assert "set back" in "; ".join(found.assumed)


def test_rows_that_are_sent_again_later_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(text([*BASE[:310], *BASE[303:308], *BASE[310:]]))
    found = load(path, WANTED)
    np.testing.assert_array_equal(found["angle"], ANGLE)
    assert "5 rows are repeated" in "; ".join(found.assumed)


def test_time_that_stands_still_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(timed(lambda i: "1.0"))
    with pytest.raises(RecordingError, match="is the same in all rows") as caught:
        load(path, WANTED, said_of(("time=time",), ()))
    assert "--map time=row:0.01" in caught.value.remedy


def test_infinite_values_are_not_known(tmp_path: Path) -> None:
    path = tmp_path / "run.parquet"
    path.write_bytes(parquet(columns(TIME, np.where(np.arange(COUNT) % 100 == 0, np.inf, ANGLE))))
    found = load(path, WANTED)
    assert np.isnan(found["angle"]).sum() == 6
    assert "angle: 6 infinite values are not known" in found.assumed


def test_part_that_a_vehicle_does_not_have_is_at_rest(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(text(BASE))
    wanted = (*WANTED, Wanted("trim", "m", part="trim mass"), Wanted("trim_rate", "m/s", part="trim mass"))
    found = load(path, wanted)
    assert not found["trim"].any()
    assert not found["trim_rate"].any()
    assert "trim mass is at rest" in found.assumed[-1]
    path.write_bytes(extra("trim", lambda i: "0.1"))
    assert "trim_rate" not in load(path, wanted).values


def test_rate_between_samples_is_not_made_up_across_a_gap(tmp_path: Path) -> None:
    rows = [(TIME[i], "", ROWS[i][2]) for i in range(0, COUNT, 2)]
    rows += [(i / RATE + 0.003, f"{RATES[i]:.6f}", "") for i in range(COUNT) if not 200 <= i < 260]
    (tmp_path / "run.csv").write_bytes(sparse(rows, "time,rate,angle"))
    wanted = (Wanted("rate", "rad/s", measured=True), Wanted("angle", "rad", measured=True))
    found = load(tmp_path / "run.csv", wanted)
    assert len(found) == COUNT // 2
    np.testing.assert_array_equal(found["angle"], ANGLE[::2])
    inside = np.arange(5, 95)
    np.testing.assert_allclose(found["rate"][inside], np.interp(found.time[inside], TIME + 0.003, RATES), atol=1e-5)
    assert np.flatnonzero(~np.isfinite(found["rate"])).tolist() == [0, *range(100, 131)]
