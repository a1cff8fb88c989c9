"""Which format a file is, and the tables in it.

The content decides, by the bytes that each format begins with; the suffix only for those that have none.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from gc import collect
from importlib import import_module
from io import StringIO
from logging import CRITICAL, disable
from logging import root as logging_root
from pathlib import Path
from warnings import catch_warnings, simplefilter

from upright.telemetry.errors import RecordingError
from upright.telemetry.options import option
from upright.telemetry.tables.raw import RawTable

Reader = Callable[[Path], Sequence[RawTable]]
LONGEST = 128
"""Bytes at the beginning of a file from which its format is found."""


@dataclass(frozen=True, slots=True)
class Format:
    """A format of files: its `name`, the `module` of this folder whose function `read` reads it, and the bytes that a
    file `begins` with. `remedy`: what to do with a file that cannot be read."""

    name: str
    module: str
    suffixes: tuple[str, ...]
    begins: tuple[bytes, ...] = ()
    remedy: str = "Copy the file again, or export it from the program that wrote it."


TEXT = Format("table of text", "text.text_file", (".csv", ".txt", ".tsv", ".dat", ".lvm", ".tab"))
ROSBAG2 = Format(
    "rosbag 2",
    "rosbag2",
    (".db3",),
    (b"SQLite format 3\0",),
    "Copy the bag again; `ros2 bag reindex` repairs one that was cut off.",
)
FORMATS = (
    Format("Arrow", "arrow", (".arrow", ".feather", ".ipc"), (b"ARROW1", b"FEA1", b"\xff\xff\xff\xff")),
    Format("Parquet", "parquet", (".parquet", ".pq"), (b"PAR1",)),
    Format("MF4", "mf4", (".mf4", ".mdf"), (b"MDF ", b"UnFinMF ")),
    Format("MCAP", "mcap", (".mcap",), (b"\x89MCAP0\r\n",), "`mcap recover` repairs one that was cut off."),
    Format("rosbag 1", "rosbag1", (".bag",), (b"#ROSBAG V2.0",), "`rosbag reindex` repairs one that was cut off."),
    ROSBAG2,
    Format("ULog", "ulog", (".ulg",), (b"ULog\x01\x12\x35",)),
    Format("dataflash", "dataflash", (".bin",), (b"\xa3\x95\x80",)),
    Format("MAT", "mat", (".mat",), (b"MATLAB 5.0", b"MATLAB 7."), "Save it again in MATLAB."),
    TEXT,
)
EXTRAS = {
    "asammdf": "mf4",
    "mcap": "mcap",
    "rosbags": "ros",
    "pyulog": "ulog",
    "pymavlink": "ardupilot",
    "matio": "mat",
}
"""The extras of upright by the packages that they bring."""
SUFFIXES = tuple(suffix for each in FORMATS for suffix in each.suffixes)


def raw_tables(path: Path) -> Sequence[RawTable]:
    """The tables in a file, or in the folder of a rosbag 2: several if it has topics with clocks of their own.

    Raises RecordingError, OSError.
    """
    found = _format(path)
    if found is None:
        raise unknown_suffix(path, SUFFIXES)
    read: Reader = import_module(f"upright.telemetry.formats.{found.module}").read
    tables, failure = _taken(read, path)
    if failure:
        raise RecordingError(str(path), "", f"cannot be read as {found.name} ({failure})", remedy=found.remedy)
    if not tables:
        raise RecordingError(str(path), "", f"holds no numbers over time ({found.name})", remedy="Record again.")
    return tables


def _taken(read: Reader, path: Path) -> tuple[Sequence[RawTable], str]:
    """What `read` gives, or why it failed: the packages fail in many ways where a file is not what it claims to be."""
    with quiet():
        try:
            return read(path), ""
        except (RecordingError, OSError):
            raise
        except ModuleNotFoundError as error:
            raise missing(path, error) from error
        except MemoryError:
            failure = "it states more than there is memory for"
        except Exception as error:
            failure = f"{type(error).__name__}: {error}"
        collect()
        return (), failure


def missing(path: Path, error: ModuleNotFoundError) -> RecordingError:
    """That a package is not installed, with the extra that brings it."""
    package = (error.name or "").partition(".")[0]
    remedy = f"pip install 'upright[{EXTRAS.get(package, 'formats')}]'."
    return RecordingError(str(path), "", f"needs the package {package}", remedy=remedy)


def unknown_suffix(path: Path, known: Sequence[str]) -> RecordingError:
    """That no format has the suffix of `path`."""
    what = f"recordings are not stored as {path.suffix or 'files without a suffix'}"
    remedy = f"Use one of {', '.join(known)}."
    if path.suffix == ".log":
        terminal = "`upright replay FILE --vehicle V`, or `upright convert` it first"
        remedy = f"A raw CAN log needs its vehicle: {option(terminal, 'vehicle=')}."
    return RecordingError(str(path), "", what, remedy=remedy)


def _format(path: Path) -> Format | None:
    if path.is_dir():
        return ROSBAG2
    by_suffix = next((each for each in FORMATS if path.suffix.lower() in each.suffixes), None)
    if by_suffix is None and not path.exists():
        return None
    with path.open("rb") as file:
        start = file.read(LONGEST)
    return next((each for each in FORMATS if start.startswith(each.begins)), by_suffix)


@contextmanager
def quiet() -> Iterator[None]:
    """Without what the packages print and warn of. Objects of theirs that were not made to their end complain when they
    go: after a failure, call `gc.collect` in here, where nobody hears it."""
    logged, complain = logging_root.manager.disable, sys.unraisablehook
    with catch_warnings(), redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        simplefilter("ignore")
        disable(CRITICAL)
        sys.unraisablehook = lambda _: None
        try:
            yield
        finally:
            sys.unraisablehook = complain
            disable(logged)
