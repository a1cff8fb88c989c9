"""How many dialects of tables, CAN logs and data sheets are read right, asked about, or wrong?

`python benchmarks/dialects.py` tries those of the tests, and with `--field FOLDER` those that the generators of a
folder make: `tables.py` (a pendulum's table, whose model `pendulum.toml` lacks nothing), `can_logs.py` (a raw log of
the virtual vehicle) and `eds_faults.py` (the shipped data sheet). `--list` prints what became of each dialect.

`right`: the values are those that were written, and the diagnosis of a table names nothing but what the dialect itself
is (a delay, a limit). `asked`: refused, or asked about, with a remedy. `other name`: an effect that is not there.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import runpy
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import upright

ROOT = Path(__file__).resolve().parents[1]
TESTS = ("", "support", "telemetry", "drivers", "service/offline")
"""Folders of the tests whose dialects are tried."""
INTEGER16, DOMAIN = 0x03, 0x0F
OUTCOMES = ("right", "asked", "other name", "wrong", "traceback")
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a dialect: `kind` is one of OUTCOMES, `words` say more."""

    kind: str
    words: str = ""


Dialects = Iterator[tuple[str, Callable[[Path], Outcome]]]
"""Names, and what tries each in a folder of its own."""


def tried(dialect: Callable[[Path], Outcome]) -> Outcome:
    """The outcome of a dialect, whatever it raises."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        try:
            return dialect(Path(folder))
        except upright.UprightError as error:
            return Outcome("asked" if error.remedy else "traceback", str(error))
        except AssertionError as error:
            return Outcome("wrong", " ".join(str(error).split())[:200])
        except Exception:
            return Outcome("traceback", traceback.format_exc(limit=-1).strip().replace("\n", " "))


# Those of the tests


def of_test(kind: str, check: Callable[..., None], *values: Any) -> Callable[[Path], Outcome]:
    """A dialect that a test checks: `kind` is what the test expects of it."""

    def dialect(folder: Path) -> Outcome:
        check(*values, folder)
        return Outcome(kind)

    return dialect


def own_tables() -> Dialects:
    import test_formats
    import test_tables

    for case in test_tables.READ:
        yield case.name, of_test("right", test_tables.test_dialect_is_read_right, case)
    for refused in test_tables.REFUSED:
        yield (
            refused[0],
            of_test("asked", test_tables.test_table_that_is_not_clear_is_refused_with_the_remedy, *refused),
        )
    for case in test_formats.CASES:
        yield case.name, of_test("right", test_formats.test_format_is_read_right, case)


def own_logs() -> Dialects:
    import test_can_logs as tests

    from upright.telemetry.candump import format_frames

    heard = tests.heard_frames()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.log"
        log.write_text(format_frames(heard, ("can0",)))
        right = tests.load_recording(log, tests.VEHICLE)
    for dialect in tests.READ:
        yield dialect.name, of_test("right", tests.test_log_is_read_and_right, dialect, heard, right)
    for dialect in tests.REFUSED:
        yield dialect.name, of_test("asked", tests.test_log_is_refused_with_the_remedy, dialect, heard)


def own_sheets() -> Dialects:
    import test_eds as tests

    for fault in tests.FAULTS:
        if fault.refused:
            yield fault.name, of_test("asked", tests.test_fault_is_refused_with_section_key_and_remedy, fault)
        else:
            yield fault.name, of_test("right", tests.test_fault_is_repaired_and_said, fault)


# Those of a folder


@contextlib.contextmanager
def inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@dataclass(frozen=True, slots=True)
class Truth:
    """What a table holds: s, V and rad, (n,). `limit` is what its angle is rounded by, `late` s what its time stamps
    may be off by, and `named` are the effects that it has of itself."""

    time: Array
    voltage: Array
    angle: Array
    limit: float = 1e-5
    late: float = 1e-5
    named: tuple[str, ...] = ()


def truths(rows: Sequence[Sequence[str]]) -> dict[str, Truth]:
    """By the number of a dialect of `tables.py`; "" is all others."""
    time, voltage, angle = np.array(rows, dtype=np.float64).T
    place = np.arange(len(time))
    kept = np.concatenate((place[:1500], place[1540:2699], place[2759:]))
    wide = {bits: np.pi / bits for bits in (4096, 400)}  # half a count
    return {
        "": Truth(time, voltage, angle),
        "26": Truth(np.where(place < 2000, time, time + 0.09), voltage, angle),  # a gap of ten samples
        "40": Truth(time, voltage, angle, late=0.006),
        "41": Truth(time[kept], voltage[kept], angle[kept]),
        "48": Truth(time, voltage, angle, limit=1.01 * wide[4096]),
        "49": Truth(time, voltage, angle, limit=1.01 * wide[400]),
        "50": Truth(time, voltage, np.clip(angle, -0.35, 0.35), named=("sensor_saturation",)),
        "56": Truth(time[:-1], voltage[:-1], angle[1:], named=("input_delay",)),
    }


def tables(field: Path) -> Dialects:
    with tempfile.TemporaryDirectory() as folder, inside(Path(folder)):
        with contextlib.redirect_stdout(io.StringIO()):
            rows = runpy.run_path(str(field / "tables.py"))["R"]
        known = truths(rows)
        for path in sorted(Path(folder).glob("*.csv")):
            truth = known.get(path.name[:2], known[""])
            yield path.name, lambda _, path=path, truth=truth: diagnosed(path, field / "pendulum.toml", truth)


def diagnosed(path: Path, model: Path, truth: Truth) -> Outcome:
    recording = upright.load(path, model=model)
    answer = upright.diagnose(recording, model)
    if answer.verdict == "insufficient_data":
        return Outcome("asked", str(answer).strip().replace("\n", " "))
    assert len(recording) == len(truth.time), f"{len(recording)} rows of {len(truth.time)}"
    for name, limit, right in (("voltage", 1e-4, truth.voltage), ("angle", truth.limit, truth.angle)):
        known = np.isfinite(recording[name])
        assert known.mean() > 0.95, f"{name}: {known.mean():.0%} known"
        np.testing.assert_allclose(recording[name][known], right[known], rtol=0.0, atol=limit, err_msg=name)
    np.testing.assert_allclose(recording.time, truth.time - truth.time[0], rtol=0.0, atol=truth.late)
    names = [each.effect for each in answer.findings]
    kind = "right" if set(names) <= set(truth.named) else "other name"
    return Outcome(kind, f"{answer.verdict} {', '.join(names)}")


def logs(field: Path) -> Dialects:
    import test_can_logs as tests

    from upright.telemetry.candump import format_frames

    with tempfile.TemporaryDirectory() as folder, inside(Path(folder)):
        whole = Path(folder) / "whole.log"
        whole.write_text(format_frames(tests.heard_frames(), ("can0",)))
        right = tests.load_recording(whole, tests.VEHICLE)
        run_with(field / "can_logs.py", str(whole))
        for path in sorted(Path(folder).glob("d*.log")):
            yield path.name, lambda _, path=path: same(tests.load_recording(path, tests.VEHICLE), right, tests.CHANNELS)


def same(found: Any, right: Any, channels: Sequence[str]) -> Outcome:
    assert len(found) == len(right), f"{len(found)} samples of {len(right)}"
    for name in channels:
        np.testing.assert_allclose(found[name], right[name], atol=2e-6, err_msg=name)
    np.testing.assert_allclose(found.time, right.time, atol=2e-6)
    return Outcome("right", found.truncated)


def run_with(script: Path, *arguments: str) -> dict[str, Any]:
    """What a script has at its end, which is run with `arguments`."""
    before, sys.argv = sys.argv, [str(script), *arguments]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            return runpy.run_path(str(script))
    finally:
        sys.argv = before


def sheets(field: Path) -> Dialects:
    import test_eds as tests

    with inside(ROOT):
        cases = run_with(field / "eds_faults.py")["cases"]
    for name, content in cases.items():
        data = content[1].encode(content[0]) if isinstance(content, tuple) else content.encode()
        yield name, lambda folder, data=data: sheet(tests, folder, data)


def sheet(tests: Any, folder: Path, data: bytes) -> Outcome:
    """Read, with the objects that the drive is driven by as they are in the whole sheet."""
    found, warnings = tests.loaded(folder, data)
    whole, _ = tests.loaded(folder, tests.TEXT)
    for entry in tests.DRIVE.mapped_objects:
        variable, right = (each.get_variable(entry.index, entry.subindex) for each in (found, whole))
        assert variable is not None, f"{entry.index:X}h is not there"
        known = (right.data_type, entry.data_type, DOMAIN, INTEGER16)  # a type of another sign, or none, is not used
        assert variable.data_type in known, f"{entry.index:X}h: {variable.data_type}"
    assert found[0x1018][1].default == whole[0x1018][1].default, "another vendor"
    return Outcome("right", "; ".join(warnings))


def counted(title: str, dialects: Dialects, *, every: bool) -> Counter[str]:
    """Try all, and print a row of the table."""
    counts: Counter[str] = Counter()
    for name, dialect in dialects:
        outcome = tried(dialect)
        counts[outcome.kind] += 1
        if every or outcome.kind not in ("right", "asked"):
            print(f"    {outcome.kind:10}  {name}: {outcome.words}", file=sys.stderr)
    print(f"| {title} | {counts.total()} | {' | '.join(str(counts[each]) for each in OUTCOMES)} |", flush=True)
    return counts


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--field", type=Path, help="folder of the generators of further dialects")
    parser.add_argument("--only", choices=("tables", "logs", "sheets"), help="one kind of dialects")
    parser.add_argument("--list", action="store_true", help="print each dialect")
    chosen = parser.parse_args()
    sys.path[:0] = [str(ROOT / "tests" / folder) for folder in TESTS]
    print(f"| dialects | tried | {' | '.join(OUTCOMES)} |\n|---|{'---:|' * (1 + len(OUTCOMES))}")
    kinds = [
        ("tables", "tables and logs of other programs", own_tables()),
        ("logs", "CAN logs", own_logs()),
        ("sheets", "data sheets", own_sheets()),
    ]
    if chosen.field:
        field = chosen.field.resolve()
        kinds += [
            ("tables", "tables, field", tables(field)),
            ("logs", "CAN logs, field", logs(field)),
            ("sheets", "data sheets, field", sheets(field)),
        ]
    kinds = [each for each in kinds if chosen.only in (None, each[0])]
    found = [counted(title, dialects, every=chosen.list) for _, title, dialects in kinds]
    return int(any(each[kind] for each in found for kind in OUTCOMES[2:]))


if __name__ == "__main__":
    sys.exit(main())
