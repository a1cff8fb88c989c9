"""`make faults`: every fault in every part of a run, for every vehicle, as one table.

PYTHONPATH=tests python -m faults.table [--vehicle monocab] [--phase excite] [--only imu_silent] [--markdown]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Iterator, Sequence

from faults.campaign import Result, campaign
from faults.fault import EXPERIMENTS, SIDE_LOAD, VEHICLES, When
from faults.scenarios import FAULTS

COLUMNS = (
    "fault",
    "where",
    "end",
    "code",
    "known ms",
    "detected ms",
    "fell ms",
    "off ms",
    "peak deg",
    "impact",
    "verdict",
)
WIDTHS = (30, 26, 14, 18, 8, 11, 8, 8, 8, 6, 0)


def row(result: Result) -> tuple[str, ...]:
    """The cells of one result, as text."""
    outcome = result.outcome
    times = (outcome.known, outcome.delay, outcome.fell, outcome.off)
    return (
        outcome.fault,
        str(outcome.situation),
        outcome.end.value,
        outcome.code,
        *["-" if time is None else f"{time:.0f}" for time in times],
        f"{outcome.peak:.2f}",
        f"{outcome.impact:.1f}",
        "; ".join(result.wrong) or "as expected",
    )


def text(cells: Sequence[str]) -> str:
    return " ".join(cell.ljust(width) for cell, width in zip(cells, WIDTHS, strict=True)).rstrip()


def markdown(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Inject every fault into the virtual vehicle, and print what becomes of it."
    )
    names = [fault.name for fault in FAULTS]
    parser.add_argument("--vehicle", action="append", choices=VEHICLES, help="default: all")
    parser.add_argument("--phase", action="append", type=When, choices=list(When), help="default: all")
    parser.add_argument("--experiment", action="append", choices=(*EXPERIMENTS, SIDE_LOAD), help="default: all")
    parser.add_argument("--only", action="append", choices=names, metavar="NAME", help="this fault; may be repeated")
    parser.add_argument("--processes", type=int, default=2, help="at a time (default: 2)")
    parser.add_argument("--once", action="store_true", help="each fault in its first experiment only")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--markdown", action="store_true", help="print a table for a page")
    form.add_argument("--json", action="store_true", help="print one JSON object a line")
    return parser.parse_args(arguments)


def document(result: Result) -> str:
    """The result as JSON."""
    outcome = dataclasses.asdict(result.outcome) | {"end": result.outcome.end.value}
    return json.dumps(outcome | {"switched_off": result.impact, "wrong": result.wrong})


def results(chosen: argparse.Namespace) -> Iterator[Result]:
    """Those of the chosen vehicles, experiments, phases and faults."""
    faults = [fault for fault in FAULTS if not chosen.only or fault.name in chosen.only]
    for kind in chosen.vehicle or VEHICLES:
        for experiment in chosen.experiment or (*EXPERIMENTS, SIDE_LOAD):
            these = [fault for fault in faults if kind in fault.kinds and experiment in fault.experiments]
            if chosen.once:
                these = [fault for fault in these if fault.experiments[0] == experiment]
            if these:
                yield from campaign(kind, experiment, chosen.phase or list(When), these, chosen.processes)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 1 if an outcome is not as expected."""
    chosen = parsed(arguments)
    line = markdown if chosen.markdown else text
    if not chosen.json:
        print(line(COLUMNS))
    if chosen.markdown:
        print(line(["---"] * len(COLUMNS)))
    count = wrong = 0
    for result in results(chosen):
        print(document(result) if chosen.json else line(row(result)), flush=True)
        count += 1
        wrong += bool(result.wrong)
    if not chosen.json:
        print(f"\n{count - wrong} of {count} as expected")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
