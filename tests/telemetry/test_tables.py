"""Every dialect of a table: read with the right values, and said what was assumed, or refused with the remedy."""

from __future__ import annotations

from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from dialects import (
    ANGLE,
    BASE,
    COUNT,
    EPOCH,
    HEADER,
    ROWS,
    TIME,
    VOLTAGE,
    WANTED,
    arduino,
    columns,
    commas,
    date,
    dated,
    degrees,
    extra,
    feather,
    headed,
    in_turns,
    influx,
    labview,
    lines,
    oscilloscope,
    own_clocks,
    parquet,
    picoscope,
    rigol,
    ros_stamps,
    rosbag,
    sparse,
    stream,
    text,
    tidy,
    timed,
    with_holes,
)

from upright.telemetry.recording import Recording
from upright.telemetry.storage import load
from upright.telemetry.tables.mapping import said_of

ALL = np.arange(COUNT)


@dataclass(frozen=True)
class Read:
    """Read right: `rows` of the base (all by default), with `says` in what was assumed. `rest` are the absolute limits
    of what a dialect rounds."""

    name: str
    content: bytes
    says: str = ""
    rows: np.ndarray = field(default_factory=lambda: ALL)
    unknown: np.ndarray = field(default_factory=lambda: np.array([], dtype=int))
    suffix: str = ".csv"
    maps: tuple[str, ...] = ()
    assumes: tuple[str, ...] = ()
    time_limit: float = 1e-6
    limit: float = 1e-5
    voltage: np.ndarray | None = None
    angle: np.ndarray | None = None
    time: np.ndarray | None = None
    last: bool = True


def without(rows: object) -> np.ndarray:
    return np.setdiff1d(ALL, np.asarray(rows))


HOLES = np.flatnonzero(ALL % 97 == 5)
MOVED = np.where(ALL < 300, TIME, TIME + 0.09)
"""A clock that was set at row 300: a gap of ten samples."""

READ = (
    Read("as it is", text(BASE), "time: in s, since no unit is stated"),
    # Encodings and ends of lines
    Read("BOM", text(BASE, encoding="utf-8-sig"), "UTF-8, by its byte order mark"),
    Read("UTF-16 with BOM", text(BASE, encoding="utf-16"), "UTF-16"),
    Read("UTF-16 without BOM", text(BASE, encoding="utf-16-le"), "UTF-16, by its zero bytes"),
    Read("UTF-16 big-endian", text(BASE, encoding="utf-16-be"), "UTF-16, by its zero bytes"),
    Read(
        "Windows-1252",
        headed("time", "voltage", "angle [°]", rows=[(*row[:2], degrees(i)) for i, row in enumerate(ROWS)])
        .decode()
        .encode("cp1252"),
        "Windows-1252",
    ),
    Read("DOS lines", text(BASE, "\r\n")),
    Read("old Mac lines", text(BASE, "\r")),
    Read("lines of both", text(BASE, "\r\r\n")),
    Read("no end of the last line", text(BASE).rstrip(b"\n")),
    Read("zeros at the end", text(BASE) + b"\0" * 512, "512 zero bytes at the end"),
    Read("Ctrl-Z at the end", text(BASE) + b"\x1a"),
    # Separators, quotes, decimal marks
    Read("semicolon", text(lines([HEADER, *ROWS], ";")), "separator: semicolon"),
    Read("tab", text(lines([HEADER, *ROWS], "\t")), "separator: tab", suffix=".tsv"),
    Read("vertical bar", text(lines([HEADER, *ROWS], "|")), "separator: vertical bar"),
    Read("spaces", text(lines([HEADER, *ROWS], "   ")), "separator: spaces", suffix=".txt"),
    Read(
        "aligned", text([f"{a:>12}{b:>14}{c:>14}" for a, b, c in [HEADER, *ROWS]]), "separator: spaces", suffix=".dat"
    ),
    Read("spaces after commas", text(lines([HEADER, *ROWS], ", "))),
    Read("semicolon, decimal comma", text(lines([HEADER, *commas()], ";")), "decimal mark: comma"),
    Read("tab, decimal comma", text(lines([HEADER, *commas()], "\t")), "decimal mark: comma"),
    Read(
        "decimal comma in quotes",
        text(lines([HEADER, *[[f'"{each}"' for each in row] for row in commas()]])),
        "decimal mark: comma",
    ),
    Read("sep= of Excel", text(["sep=;", *lines([HEADER, *commas()], ";")], "\r\n"), "decimal mark: comma"),
    Read("quotes", text(lines([[f'"{each}"' for each in row] for row in [HEADER, *ROWS]])), "fields in quotes"),
    Read("quoted header", text(['"time","voltage","angle"', *lines(ROWS)])),
    Read("single quotes in header", headed("'time'", "'voltage'", "'angle'")),
    Read("trailing comma", text([f"{line}," for line in BASE])),
    Read("trailing comma in data only", text([BASE[0], *(f"{line}," for line in BASE[1:])])),
    Read("trailing semicolons", text([f"{line};;" for line in lines([HEADER, *ROWS], ";")])),
    Read("trailing tab", text([f"{line}\t" for line in lines([HEADER, *ROWS], "\t")])),
    Read("leading spaces", text([f"  {line}" for line in BASE])),
    Read(
        "thousands",
        headed("time [ms]", "voltage", "angle", rows=[(f'"{10 * i:,}.0"', *row[1:]) for i, row in enumerate(ROWS)]),
        "in ms, as its heading states",
    ),
    Read(
        "German thousands",
        headed(
            "time [ms]",
            "voltage",
            "angle",
            separator=";",
            rows=[(f"{10 * i:,}".replace(",", ".") + ",0", *row[1:]) for i, row in enumerate(commas())],
        ),
        "in ms",
    ),
    Read("minus sign", text([line.replace("-", "−") for line in BASE])),
    Read(
        "plus signs",
        headed(*HEADER, rows=[tuple(each if each[0] == "-" else f"+{each}" for each in row) for row in ROWS]),
    ),
    Read("exponents", headed(*HEADER, rows=[tuple(f"{float(each):.7E}" for each in row) for row in ROWS])),
    Read(
        "exponents of Fortran",
        headed(*HEADER, rows=[tuple(f"{float(each):.7E}".replace("E", "D") for each in row) for row in ROWS]),
    ),
    Read(
        "units beside the numbers",
        headed(*HEADER, rows=[(f"{10 * i} ms", f"{row[1]} V", f"{degrees(i)}°") for i, row in enumerate(ROWS)]),
        "angle: °, converted to rad",
    ),
    # Above the table
    Read(
        "comments",
        text(["# recorded 2024-03-01 by bench 2", "# fs = 100 Hz", *BASE]),
        "2 lines above the table left out",
    ),
    Read("commented header", text(["# time voltage angle", *lines(ROWS, " ")]), suffix=".txt"),
    Read("commented header, commas", text(["# time,voltage,angle", *lines(ROWS)])),
    Read("header of MATLAB", text(["% time, voltage, angle", *lines(ROWS)])),
    Read("title", text(["Bench 2", "", *BASE]), "1 line above the table left out"),
    Read(
        "names and values above",
        text(["Serial;4711", "Operator;Meyer", "Rate;100", "", *lines([HEADER, *commas()], ";")]),
        "3 lines above",
    ),
    Read("units row", text([BASE[0], "s,V,rad", *BASE[1:]]), "units from a row of their own"),
    Read(
        "units row in brackets",
        text([BASE[0], "[s],[V],[deg]", *lines([(*row[:2], degrees(i)) for i, row in enumerate(ROWS)])]),
        "angle: deg, converted to rad",
    ),
    Read(
        "units row of ms",
        text(
            [
                BASE[0],
                "ms,mV,rad",
                *lines([(f"{10 * i}", f"{1000 * VOLTAGE[i]:.1f}", row[2]) for i, row in enumerate(ROWS)]),
            ]
        ),
        "voltage: mV, converted to V",
    ),
    Read("row of types", text([BASE[0], "double,double,double", *BASE[1:]])),
    Read("no header", text(lines(ROWS)), "no headings", maps=("time=column1", "voltage=column2", "angle=column3")),
    Read("no header, time first", text(lines(ROWS)), "time: column column1", maps=("voltage=column2", "angle=column3")),
    Read("header once more", text([*BASE[:300], BASE[0], *BASE[300:]]), "line 301: 'time,voltage,angle'"),
    # Columns that are no channels
    Read("index without a heading", text([f",{BASE[0]}", *(f"{i},{line}" for i, line in enumerate(BASE[1:]))])),
    Read("index of pandas", text([f"Unnamed: 0,{BASE[0]}", *(f"{i},{line}" for i, line in enumerate(BASE[1:]))])),
    Read("index of R", text([BASE[0], *(f'"{i + 1}",{line}' for i, line in enumerate(BASE[1:]))]), "counts the rows"),
    Read("text column", extra("state", lambda i: "RUN"), "state: text, left out"),
    Read(
        "text that changes", extra("state", lambda i: ("RUN", "STOP, now", "")[i % 3].replace(",", "")), "state: text"
    ),
    Read("booleans", extra("armed", lambda i: ("True", "False")[i % 2]), "armed: yes or no"),
    Read("on and off", extra("relay", lambda i: ("on", "off")[i % 2]), "relay: yes or no"),
    Read("empty column", extra("remark", lambda i: "")),
    Read("headings twice", headed(*HEADER, "temp", "temp", rows=[(*row, "1", "2") for row in ROWS]), "numbered: temp"),
    # Holes
    *(
        Read(f"hole {each!r}", with_holes(each), unknown=HOLES)
        for each in (
            "",
            " ",
            "-",
            "--",
            "NaN",
            "nan",
            "NA",
            "N/A",
            "#N/A",
            "#NV",
            "null",
            "NULL",
            "None",
            "?",
            ".",
            "1.#QNAN",
            "-1.#IND",
            "#DIV/0!",
            "*",
            "<NA>",
            "NaT",
            "inf",
            "-inf",
        )
    ),
    Read("hole -9999", with_holes("-9999"), "stand for unknown", unknown=HOLES),
    Read("hole 9.91E+37 of SCPI", with_holes("9.91E+37"), unknown=HOLES),
    Read("hole of another spelling", with_holes("sensor lost"), "angle: 7 fields are no numbers", unknown=HOLES),
    Read(
        "blank rows", text([each for i, line in enumerate(BASE) for each in ([line, ",,"] if i % 100 == 7 else [line])])
    ),
    Read("empty lines", text([each for line in BASE for each in (line, "")])),
    Read("cut-off last line", text(BASE)[:-12], rows=ALL[:-1]),
    Read(
        "cut-off line inside", text([*BASE[:200], BASE[200][:5], *BASE[201:]]), "1 line is no data", rows=without([199])
    ),
    Read("messages inside", text([*BASE[:200], "WARNING: buffer full", *BASE[200:]]), "1 line is no data"),
    # Names
    *(
        Read(f"header {each!r}", timed(lambda i: f"{TIME[i]:.4f}", each))
        for each in (
            "Time",
            "t",
            "timestamp",
            "__time",
            "time (s)",
            "time [s]",
            "Time_s",
            "seconds",
            "TIME",
            '"Time, s"',
            "time/s",
            "t [s]",
            "t_s",
            "Zeit [s]",
            "elapsed",
            "Elapsed Time (s)",
            "rel_time",
            "time_stamp",
            "sec",
            "/clock/time",
            "Time [sec]",
        )
    ),
    Read("upper case", headed("TIME", "VOLTAGE", "ANGLE"), "angle: column 'ANGLE'"),
    Read(
        "paths",
        headed("__time", "/motor/voltage", "/joint_states/pivot/angle"),
        "angle: column '/joint_states/pivot/angle'",
    ),
    Read("own names", headed("time", "u", "pos"), maps=("voltage=u", "angle=pos")),
    Read(
        "own names and units",
        headed("tick", "u", "pos", rows=[(f"{10 * i}", f"{1000 * VOLTAGE[i]:.1f}", degrees(i)) for i in range(COUNT)]),
        "angle: in deg, as stated",
        maps=("time=tick:ms", "voltage=u:mV", "angle=pos:deg"),
    ),
    Read("names with units", headed("time [s]", "voltage [V]", "angle [rad]")),
    Read(
        "rows alone",
        headed("voltage", "angle", rows=[row[1:] for row in ROWS]),
        "0.01 s from row to row",
        maps=("time=row:0.01",),
    ),
    # Units
    *(
        Read(
            f"unit in {each!r}",
            headed("time", "voltage", each, rows=[(*row[:2], degrees(i)) for i, row in enumerate(ROWS)]),
            "converted to rad",
        )
        for each in (
            "angle [deg]",
            "angle (deg)",
            "angle (°)",
            "angle/°",
            "angle_deg",
            "angle in deg",
            "Angle (degrees)",
            '"angle, deg"',
            "angle deg",
            "Angle_Degrees",
            "angle {deg}",
        )
    ),
    Read(
        "mV in the heading",
        headed(
            "time",
            "voltage (mV)",
            "angle",
            rows=[(row[0], f"{1000 * VOLTAGE[i]:.1f}", row[2]) for i, row in enumerate(ROWS)],
        ),
        "mV, converted to V",
    ),
    Read(
        "degrees, as stated",
        headed(*HEADER, rows=[(*row[:2], degrees(i)) for i, row in enumerate(ROWS)]),
        "angle: in deg, as stated",
        assumes=("angle=deg",),
    ),
    Read(
        "turned, as stated",
        headed(*HEADER, rows=[(*row[:2], f"{-ANGLE[i]:.6f}") for i, row in enumerate(ROWS)]),
        "angle: in -1, as stated",
        assumes=("angle=-1",),
    ),
    Read(
        "PWM, as stated",
        headed(*HEADER, rows=[(row[0], f"{VOLTAGE[i] * 255 / 12:.5f}", row[2]) for i, row in enumerate(ROWS)]),
        "voltage: in 12/255, as stated",
        assumes=("voltage=12/255",),
    ),
    Read(
        "swapped, as stated",
        headed("time", "angle", "voltage"),
        "swapped, as stated",
        assumes=("angle=swapped:voltage",),
    ),
    Read(
        "wrapped, as stated",
        headed(*HEADER, rows=[(*row[:2], f"{ANGLE[i] % 0.4:.6f}") for i, row in enumerate(ROWS)]),
        "unwrapped",
        assumes=("angle=wrapped:0.4",),
        angle=ANGLE + 0.4,
    ),
    # Time
    Read("ms in the name", timed(lambda i: f"{10 * i}", "time_ms"), "in ms"),
    Read("ms in brackets", timed(lambda i: f"{10 * i}", "Time [ms]"), "in ms"),
    Read("millis", timed(lambda i: f"{10 * i}", "millis"), "in ms"),
    Read("micros", timed(lambda i: f"{10_000 * i}", "t_us"), "in us"),
    Read("ns", timed(lambda i: f"{10_000_000 * i}", "timestamp_ns")),
    Read("ms, as stated", timed(lambda i: f"{10 * i}"), "in ms, as stated", assumes=("time=ms",)),
    Read("epoch s", timed(lambda i: f"{EPOCH + i / 100:.6f}"), "in s since 1970", time_limit=1e-6),
    Read("epoch ms", timed(lambda i: f"{EPOCH * 1000 + 10 * i}"), "in ms since 1970"),
    Read("epoch us", timed(lambda i: f"{EPOCH * 10**6 + 10_000 * i}"), "in us since 1970"),
    Read("epoch ns", timed(lambda i: f"{EPOCH * 10**9 + 10_000_000 * i}"), "in ns since 1970"),
    Read("ISO", timed(lambda i: date(i)), "dates"),
    Read("ISO with T and Z", timed(lambda i: date(i, "%Y-%m-%dT%H:%M:%S.%f") + "Z"), "dates"),
    Read("ISO with a zone", timed(lambda i: date(i) + "+01:00"), "dates"),
    Read("ISO with ms after a colon", timed(lambda i: date(i, "%Y-%m-%d %H:%M:%S:") + f"{10 * i % 1000:03d}"), "dates"),
    Read(
        "German dates",
        text(lines([HEADER, *[(date(i, "%d.%m.%Y %H:%M:%S,%f"), *row[1:]) for i, row in enumerate(commas())]], ";")),
        "dates",
    ),
    Read("American dates", timed(lambda i: date(i, "%m/%d/%Y %I:%M:%S.%f %p")), "dates"),
    Read("dates of MATLAB", timed(lambda i: date(i, "%d-%b-%Y %H:%M:%S.%f")), "dates"),
    Read("time of day", timed(lambda i: date(i, "%H:%M:%S.%f")), "times of day"),
    Read("minutes of Excel", timed(lambda i: date(i, "%M:%S.%f")), "times of day"),
    Read("across midnight", timed(lambda i: date(i + 12 * 360_000 - 300, "%H:%M:%S.%f")), "begins anew 1 times"),
    Read("timedelta of pandas", timed(lambda i: f"0 days 00:00:{TIME[i]:09.6f}"), "times of day"),
    Read(
        "date and time",
        headed(
            "Date",
            "Time",
            "voltage",
            "angle",
            rows=[(date(i, "%Y-%m-%d"), date(i, "%H:%M:%S.%f"), *row[1:]) for i, row in enumerate(ROWS)],
        ),
        "column Time",
    ),
    Read("whole seconds of day", timed(lambda i: date(i, "%H:%M:%S")), "rounded to 1 s"),
    Read("ROS stamps", ros_stamps(), "header.stamp.secs and header.stamp.nsecs"),
    Read("rosbag", rosbag(), "in ns since 1970"),
    Read("offset", timed(lambda i: f"{1234.5 + TIME[i]:.4f}")),
    Read("one row twice", text([*BASE[:201], BASE[200], *BASE[201:]]), "1 row is repeated"),
    Read(
        "each row twice",
        text([BASE[0], *(each for line in BASE[1:] for each in (line, line))]),
        "600 rows are repeated",
    ),
    Read("rounded to two samples", timed(lambda i: f"{i // 2 * 0.02:.2f}"), "rounded to 0.02 s"),
    Read("rounded now and then", timed(lambda i: f"{TIME[i - (i % 50 == 49)]:.2f}"), "repeated", time_limit=0.006),
    Read("set back", timed(lambda i: f"{TIME[i] - (1.0 if i >= 300 else 0.0):.4f}"), "set back by 1 s", time=MOVED),
    Read(
        "set forward",
        timed(lambda i: f"{TIME[i] + (1.7e9 if i >= 300 else 0.0):.4f}"),
        "set forward",
        time=MOVED,
        time_limit=1e-3,
    ),
    Read(
        "time unknown",
        timed(lambda i: "" if i % 100 == 50 else f"{TIME[i]:.4f}"),
        "6 rows without a time",
        rows=without(np.arange(50, COUNT, 100)),
    ),
    Read("in reverse", text([BASE[0], *reversed(BASE[1:])]), "in reverse"),
    Read("two rows exchanged", text([*BASE[:100], BASE[101], BASE[100], *BASE[102:]]), "1 row out of order"),
    Read(
        "counter of 32 bits, us",
        timed(lambda i: f"{(2**32 - 2_000_000 + 10_000 * i) % 2**32}", "micros"),
        "begins anew 1 times",
    ),
    Read("counter of 16 bits, ms", timed(lambda i: f"{(62_000 + 10 * i) % 65_536}", "millis"), "begins anew 1 times"),
    Read(
        "counter with a sign",
        timed(lambda i: f"{(2**31 - 2_000_000 + 10_000 * i + 2**31) % 2**32 - 2**31}", "t_us"),
        "begins anew 1 times",
    ),
    Read(
        "seconds of a 32-bit counter",
        timed(lambda i: f"{((2**32 - 2_000_000 + 10_000 * i) % 2**32) / 1e6:.6f}"),
        "begins anew 1 times",
    ),
    Read("dropout", text([*BASE[:150], *BASE[190:]]), rows=without(np.arange(149, 189))),
    # Several rates
    Read("in turns", in_turns(0.003), "several rates in one table", time=TIME, rows=ALL),
    Read("in turns at the same time", in_turns(0.0), "joined"),
    Read(
        "commands on change",
        sparse([(t, f"{VOLTAGE[i // 4 * 4]:.4f}" if i % 4 == 0 else "", ROWS[i][2]) for i, t in enumerate(TIME)]),
        "voltage held",
        voltage=VOLTAGE[ALL // 4 * 4],
    ),
    Read(
        "slow angle",
        sparse([(t, ROWS[i][1], ROWS[i][2] if i % 5 == 0 else "") for i, t in enumerate(TIME)]),
        "voltage averaged",
        rows=np.arange(0, COUNT, 5),
        voltage=np.convolve(VOLTAGE, np.ones(5) / 5.0, "full")[4:],
        last=False,
    ),
    Read("a row for each value", tidy(), "a row for each value"),
    Read(
        "a clock for each channel",
        own_clocks(),
        "2 columns of time",
        rows=np.arange(0, COUNT, 2),
        voltage=np.convolve(VOLTAGE, np.ones(2) / 2.0, "full")[1:],
        last=False,
    ),
    # Programs
    Read("oscilloscope", oscilloscope(), "above the table"),
    Read(
        "oscilloscope, columns to the right",
        text(
            [
                f"Record Length,600,,{','.join(ROWS[0])}",
                f"Sample Interval,0.01,,{','.join(ROWS[1])}",
                *(f",,,{','.join(row)}" for row in ROWS[2:]),
            ]
        ),
        "no headings",
        maps=("time=column4", "voltage=column5", "angle=column6"),
    ),
    Read("Rigol", rigol(), "units from a row"),
    Read("PicoScope", picoscope(), "voltage: mV, converted to V"),
    Read("LabVIEW", labview(), "decimal mark: comma", suffix=".lvm"),
    Read(
        "JSON lines",
        text([f'{{"time":{t},"motor":{{"voltage":{u}}},"angle":{a}}}' for t, u, a in ROWS]),
        "JSON in each line",
    ),
    Read(
        "brackets",
        text([f"[{', '.join(row)}]" for row in ROWS]),
        maps=("time=column1", "voltage=column2", "angle=column3"),
    ),
    Read(
        "Markdown", text(["| time | voltage | angle |", "|---|---|---|", *(f"| {' | '.join(row)} |" for row in ROWS)])
    ),
    Read("days of Excel", timed(lambda i: f"{45352.5 + i / 8_640_000:.12f}", "Date"), "in days", time_limit=1e-5),
    Read("days of MATLAB", timed(lambda i: f"{739312.5 + i / 8_640_000:.10f}", "datenum"), "in days", time_limit=2e-5),
    Read(
        "milliseconds beside the time",
        headed(
            "Time",
            "ms",
            "voltage",
            "angle",
            rows=[(date(i, "%H:%M:%S"), f"{10 * i % 1000}", *row[1:]) for i, row in enumerate(ROWS)],
        ),
        "columns Time and ms",
    ),
    Read("unit after the name", headed("Time_s", "voltage_V", "angle_rad"), "column 'voltage_V'"),
    Read("rulers", text([BASE[0], "-----,-----,-----", *BASE[1:]])),
    Read("Arduino", arduino(), "labelled in each line", suffix=".txt"),
    Read("InfluxDB", influx(), "dates"),
    # Columns of Arrow
    Read("Parquet", parquet(columns(TIME)), suffix=".parquet"),
    Read("Parquet, dates", parquet(columns(dated())), "dates", suffix=".parquet"),
    Read("Parquet, dates with a zone", parquet(columns(dated("Europe/Berlin"))), "dates", suffix=".parquet"),
    Read(
        "Parquet, decimals",
        parquet(columns(TIME, pa.array([Decimal(f"{each:.6f}") for each in ANGLE]))),
        "angle: decimals",
        suffix=".parquet",
    ),
    Read("Parquet, floats of 32 bits", parquet(columns(TIME, ANGLE.astype(np.float32))), suffix=".parquet"),
    Read(
        "Parquet, ms",
        parquet(pa.table({"time_ms": 10 * ALL, "voltage": VOLTAGE, "angle": ANGLE})),
        "in ms",
        suffix=".parquet",
    ),
    Read(
        "Parquet, index of pandas",
        parquet(pa.table({"voltage": VOLTAGE, "angle": ANGLE, "__index_level_0__": dated()})),
        "dates",
        suffix=".parquet",
    ),
    Read(
        "Parquet, text",
        parquet(columns(TIME, pa.array([row[2] for row in ROWS]))),
        "angle: text, read as numbers",
        suffix=".parquet",
    ),
    Read(
        "Parquet, states",
        parquet(columns(TIME, state=pa.array(["RUN"] * COUNT).dictionary_encode())),
        "state: text",
        suffix=".parquet",
    ),
    Read("Parquet, truth values", parquet(columns(TIME, armed=ALL % 2 == 0)), "armed: yes or no", suffix=".parquet"),
    Read(
        "Parquet, lists",
        parquet(columns(TIME, scan=pa.array([[1.0, 2.0]] * COUNT))),
        "scan: of type list",
        suffix=".parquet",
    ),
    Read(
        "Parquet, structs",
        parquet(pa.table({"time": TIME, "motor": pa.array([{"voltage": u} for u in VOLTAGE]), "angle": ANGLE})),
        "voltage: column 'motor.voltage'",
        suffix=".parquet",
    ),
    Read(
        "Parquet, nulls",
        parquet(
            columns(TIME, pa.array([None if i in HOLES else a for i, a in enumerate(ANGLE)]), remark=pa.nulls(COUNT))
        ),
        "remark: without any value",
        unknown=HOLES,
        suffix=".parquet",
    ),
    Read("Parquet, durations", parquet(columns(pa.array(10 * ALL, pa.duration("ms")))), suffix=".parquet"),
    Read(
        "Parquet, degrees",
        parquet(pa.table({"time": TIME, "voltage": VOLTAGE, "angle [deg]": np.degrees(ANGLE)})),
        "angle: deg, converted",
        suffix=".parquet",
    ),
    Read("Feather", feather(columns(dated())), "dates", suffix=".feather"),
    Read("Arrow file", feather(columns(TIME)), suffix=".arrow"),
    Read("Arrow stream", stream(columns(dated())), "dates", suffix=".arrow"),
    Read("Parquet under another name", parquet(columns(TIME)), suffix=".csv"),
)


def opened(case: Read, tmp_path: Path) -> Recording:
    path = tmp_path / f"run{case.suffix}"
    path.write_bytes(case.content)
    return load(path, WANTED, said_of(case.maps, case.assumes))


@pytest.mark.parametrize("case", READ, ids=lambda case: case.name)
def test_dialect_is_read_right(case: Read, tmp_path: Path) -> None:
    found = opened(case, tmp_path)
    rows = case.rows
    time = (TIME if case.time is None else case.time)[rows]
    assert len(found) == len(rows)
    np.testing.assert_allclose(found.time, time - time[0], rtol=0.0, atol=case.time_limit)
    until = None if case.last else -1  # what is averaged until the next row has no next one at the end
    voltage = (VOLTAGE if case.voltage is None else case.voltage)[rows]
    np.testing.assert_allclose(found["voltage"][:until], voltage[:until], rtol=0.0, atol=case.limit)
    known = ~np.isin(rows, case.unknown)
    np.testing.assert_allclose(
        found["angle"][known], (ANGLE if case.angle is None else case.angle)[rows][known], rtol=0.0, atol=case.limit
    )
    assert not np.isfinite(found["angle"][~known]).any()
    assert case.says in "; ".join(found.assumed)
