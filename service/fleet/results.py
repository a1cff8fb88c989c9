"""The results of a fleet: a Parquet file with a row for each recording, always whole.

Effects and parameters are lists within a row, since each model has its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from pathlib import Path

from upright.service.whole_file import write_whole
from upright.telemetry.errors import UprightError

FORMAT = b"upright.fleet"
"""Key of the file's metadata, with the version of its columns."""
COLUMNS = b"1"
DONE, FAILED = "done", "failed"
"""Status of a recording: diagnosed, whatever the verdict; or not read, for the reason in the row."""


class ResultsError(UprightError):
    """The results file `path` cannot be used."""

    def __init__(self, path: Path, message: str, *, remedy: str) -> None:
        super().__init__(f"{path}: {message}.", remedy=remedy)
        self.path = path


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect that the model lacks; `tied_with` those that the recording cannot distinguish from it."""

    name: str
    family: str
    probability: float
    p_value: float
    negligible: bool
    tied_with: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of the model with the missing effects. `value` and `std` are None if it is not determined, for
    `reason`. `own_std` is without the error of values taken as known, which all recordings of a vehicle have in common:
    by it they are compared with each other."""

    name: str
    value: float | None
    std: float | None
    own_std: float | None
    unit: str
    reason: str


@dataclass(frozen=True, slots=True)
class Row:
    """A recording. `recording` is its path below the folder; `vehicle` whose it is; `began` is UTC, by its own time
    stamps or, if these do not state a date, when its file was last changed (`began_by`: "recording" or "file").

    `reason` explains the verdict or the failure. `sha256` of its bytes, `model_sha256` of the file of the model or, for
    the vehicle's own model, of the vehicle; `settings` is a hash of all that was asked; `stamp` changes with the file.
    `seconds` is the computing time.
    """

    recording: str
    vehicle: str = ""
    began: datetime | None = None
    began_by: str = ""
    duration: float | None = None
    samples: int | None = None
    status: str = DONE
    verdict: str | None = None
    reason: str = ""
    effects: tuple[Effect, ...] = ()
    parameters: tuple[Parameter, ...] = ()
    innovation_ratio_before: float | None = None
    innovation_ratio_after: float | None = None
    seconds: float = 0.0
    sha256: str = ""
    model: str = ""
    model_sha256: str = ""
    version: str = ""
    settings: str = ""
    stamp: str = ""


def read(path: Path) -> list[Row]:
    """The rows of a results file. Raises ResultsError for another file."""
    import pyarrow.parquet

    remedy = "give a file that `upright fleet` wrote, or another name for the results: --out."
    try:
        table = pyarrow.parquet.read_table(path)
    except (OSError, pyarrow.ArrowException) as error:
        raise ResultsError(path, f"cannot be read ({error})", remedy=remedy) from error
    if (table.schema.metadata or {}).get(FORMAT) != COLUMNS or set(table.column_names) != {f.name for f in fields(Row)}:
        raise ResultsError(path, "holds no results of this version of `upright fleet`", remedy=remedy)
    return [
        Row(
            **{
                **row,
                "effects": tuple(Effect(**{**each, "tied_with": tuple(each["tied_with"])}) for each in row["effects"]),
                "parameters": tuple(Parameter(**each) for each in row["parameters"]),
            }
        )
        for row in table.to_pylist()
    ]


def write(path: Path, rows: Iterable[Row]) -> None:
    """Replace the file by one with these `rows`, at once. Raises OSError."""
    import pyarrow as pa
    import pyarrow.parquet

    text, number = pa.string(), pa.float64()
    effect = {"name": text, "family": text, "probability": number, "p_value": number, "negligible": pa.bool_()}
    parameter = {"name": text, "value": number, "std": number, "own_std": number, "unit": text, "reason": text}
    types = dict.fromkeys((each.name for each in fields(Row)), text) | {
        "began": pa.timestamp("us", "UTC"),
        "samples": pa.int64(),
        "effects": pa.list_(pa.struct({**effect, "tied_with": pa.list_(text)}.items())),
        "parameters": pa.list_(pa.struct(parameter.items())),
    }
    numbers = ("duration", "innovation_ratio_before", "innovation_ratio_after", "seconds")
    schema = pa.schema({**types, **dict.fromkeys(numbers, number)}, metadata={FORMAT: COLUMNS})
    sink = pa.BufferOutputStream()
    pyarrow.parquet.write_table(pa.Table.from_pylist([asdict(row) for row in rows], schema), sink)
    write_whole(path, sink.getvalue().to_pybytes())
