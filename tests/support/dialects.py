"""A pendulum's table as other programs write it: the contents of files by what they are like.

The base is 6 s at 100 Hz of the channels `time`, `voltage` and `angle`; every dialect holds the same samples.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta

import numpy as np
import pyarrow as pa
import pyarrow.feather
import pyarrow.parquet

from upright.telemetry.tables.wanted import Wanted

RATE = 100
COUNT = 600
TIME = np.arange(COUNT) / RATE
VOLTAGE = np.round(4.0 * np.sin(2.3 * TIME) + 2.0 * np.sin(7.1 * TIME + 0.4) + 0.5 * np.sin(19.0 * TIME), 4)
ANGLE = np.round(0.35 * np.sin(2.3 * TIME - 0.5) + 0.1 * np.sin(7.1 * TIME - 1.2), 6)
RATES = np.round(np.gradient(ANGLE, TIME), 6)
EPOCH = 1_709_294_400
"""2024-03-01 12:00:00 UTC."""
HEADER = ("time", "voltage", "angle")
WANTED = (Wanted("voltage", "V", held=True), Wanted("angle", "rad", measured=True))
ROWS = [(f"{t:.4f}", f"{u:.4f}", f"{a:.6f}") for t, u, a in zip(TIME, VOLTAGE, ANGLE, strict=True)]


def lines(rows: Iterable[Sequence[str]], separator: str = ",") -> list[str]:
    return [separator.join(row) for row in rows]


BASE = lines([HEADER, *ROWS])


def text(content: Sequence[str], end: str = "\n", encoding: str = "utf-8") -> bytes:
    return (end.join(content) + end).encode(encoding)


def headed(*header: str, rows: Iterable[Sequence[str]] = ROWS, separator: str = ",") -> bytes:
    """The rows under another header."""
    return text([separator.join(header), *lines(rows, separator)])


def timed(form: Callable[[int], str], header: str = "time") -> bytes:
    """Another column of time; `form` makes the text of row i."""
    return headed(header, "voltage", "angle", rows=[(form(i), *row[1:]) for i, row in enumerate(ROWS)])


def commas(rows: Iterable[Sequence[str]] = ROWS) -> list[tuple[str, ...]]:
    return [tuple(each.replace(".", ",") for each in row) for row in rows]


def with_holes(spelling: str) -> bytes:
    """Each 97th angle is unknown."""
    return headed(*HEADER, rows=[(*row[:2], spelling if i % 97 == 5 else row[2]) for i, row in enumerate(ROWS)])


def date(i: int, form: str = "%Y-%m-%d %H:%M:%S.%f") -> str:
    return (datetime.fromtimestamp(EPOCH, UTC) + timedelta(milliseconds=10 * i)).strftime(form)


def extra(name: str, values: Callable[[int], str]) -> bytes:
    """One more column."""
    return headed(*HEADER, name, rows=[(*row, values(i)) for i, row in enumerate(ROWS)])


def sparse(rows: Iterable[tuple[float, str, str]], header: str = "time,voltage,angle") -> bytes:
    return text([header, *(f"{t:.6f},{u},{a}" for t, u, a in sorted(rows, key=lambda row: row[0]))])


def in_turns(late: float) -> bytes:
    """Each row has one channel, as of a table of several topics; the angle is `late` s after the voltage."""
    commands = [(i / RATE, ROWS[i][1], "") for i in range(COUNT)]
    return sparse(commands + [(i / RATE + late, "", ROWS[i][2]) for i in range(COUNT)])


def parquet(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    pa.parquet.write_table(table, sink)
    return sink.getvalue()


def feather(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    pa.feather.write_feather(table, sink)
    return sink.getvalue()


def stream(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


def columns(time: object, angle: object = None, **more: object) -> pa.Table:
    return pa.table({"time": time, "voltage": VOLTAGE, "angle": ANGLE if angle is None else angle, **more})


def dated(zone: str | None = None) -> pa.Array:
    return pa.array((EPOCH * 1000 + 10 * np.arange(COUNT)).astype("datetime64[ms]"), pa.timestamp("us", zone))


def degrees(i: int) -> str:
    return f"{math.degrees(ANGLE[i]):.5f}"


def oscilloscope() -> bytes:
    head = ["Model,TBS1000", "Firmware Version,1.20", "Record Length,600", "Sample Interval,0.01,s", ""]
    return text([*head, "TIME,voltage,angle", *lines(ROWS)])


def rigol() -> bytes:
    head = ["X,voltage,angle,Start,Increment", "Second,Volt,rad,0.000000e+00,1.000000e-02"]
    return text([*head, *(f"{row[0]},{row[1]},{row[2]},," for row in ROWS)])


def picoscope() -> bytes:
    rows = [(f"{10 * i:.4f}", f"{1000 * VOLTAGE[i]:.1f}", ROWS[i][2]) for i in range(COUNT)]
    return text(["Time,voltage,angle", "(ms),(mV),(rad)", "", *lines(rows)])


def labview() -> bytes:
    head = ["LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab", "Decimal_Separator\t,"]
    head += ["***End_of_Header***\t", "Channels\t2\t\t", "Samples\t600\t600\t", "***End_of_Header***\t\t\t"]
    rows = [(*row, "") for row in commas()]
    return text([*head, "X_Value\tvoltage\tangle\tComment", *lines(rows, "\t")], "\r\n")


def arduino() -> bytes:
    said = ["Booting...", "IMU ok", *(f"t:{row[0]},voltage:{row[1]},angle:{row[2]}" for row in ROWS)]
    return text(["42", *said], "\r\n")


def influx() -> bytes:
    head = [
        "#group,false,false,true,true",
        "#datatype,string,long,dateTime:RFC3339,double,double",
        "#default,_result,,,,",
    ]
    rows = [f",,0,{date(i, '%Y-%m-%dT%H:%M:%S.%f')}Z,{row[1]},{row[2]}" for i, row in enumerate(ROWS)]
    return text([*head, ",result,table,_time,voltage,angle", *rows], "\r\n")


def tidy() -> bytes:
    rows = [line for row in ROWS for line in (f"{row[0]},voltage,{row[1]}", f"{row[0]},angle,{row[2]}")]
    return text(["time,name,value", *rows])


def own_clocks() -> bytes:
    """Each channel beside a time of its own; the angle at half the rate."""
    rows = [
        f"{ROWS[i][0]},{ROWS[i][1]},{f'{i / 50:.4f},{ROWS[2 * i][2]}' if 2 * i < COUNT else ','}" for i in range(COUNT)
    ]
    return text(["Time,voltage,Time,angle", *rows])


def rosbag() -> bytes:
    rows = [(f"{EPOCH * 10**9 + 10**7 * i}", f"{i}", row[1], row[2]) for i, row in enumerate(ROWS)]
    return headed("%time", "field.header.seq", "field.voltage", "field.angle", rows=rows)


def ros_stamps() -> bytes:
    rows = [(f"{EPOCH + i // 100}", f"{10_000_000 * (i % 100)}", *row[1:]) for i, row in enumerate(ROWS)]
    return headed("header.stamp.secs", "header.stamp.nsecs", "voltage", "angle", rows=rows)
