"""The whole benchmark: run the remaining cases, the reference cases first, and write every line to the file at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from upright.service.hidden_effects.cases import Case, references
from upright.service.hidden_effects.results import trials as results
from upright.service.hidden_effects.trial import DETECTABLE, Bench, Line, run
from upright.service.spread import Spread, Work

Sized = tuple[Case, Mapping[str, float]]
"""A case, and the minimum detectable sizes from its reference case."""
Progress = Callable[[int, int], None]
"""Called with the number of finished cases and of all cases."""


def benchmark(
    cases: Sequence[Case], bench: Bench, path: Path, spread: Spread, progress: Progress = lambda done, total: None
) -> dict[str, Line]:
    """Run those of `cases` that the file at `path` does not contain, and return the lines of all of them.

    The clean reference records, which give the minimum detectable effects, come first; if one fails, so do the cases
    that need it. Raises ResultsError for a file with other conditions. If the run is interrupted, all finished cases
    are in the file.
    """
    lines = results.read(path) if path.exists() else {}
    results.check(path, lines, bench.conditions)
    everything = list(dict.fromkeys((*references(cases), *cases)))
    done = len(everything) - len(results.left(everything, bench, lines))
    progress(done, len(everything))

    def sized(cases: Sequence[Case]) -> list[Sized]:
        return [(case, dict(lines.get(case.reference.key, {}).get(DETECTABLE, {}))) for case in cases]

    def take(line: Line) -> None:
        nonlocal done
        results.append(path, line)
        lines[line["key"]] = line
        done += 1
        progress(done, len(everything))

    # A reference whose diagnosis failed is repeated, since the other cases depend on it.
    able = {key: line for key, line in lines.items() if DETECTABLE in line}
    work = Work(partial(_run, bench), partial(_failed, bench))
    for line in spread(sized(results.left(references(cases), bench, able)), work):
        take(line)
    rest = []
    for case in results.left(cases, bench, lines):
        if case == case.reference:
            continue  # has just been run
        if DETECTABLE in lines.get(case.reference.key, {}):
            rest.append(case)
        else:
            reason = f"the reference case failed: {_why(lines[case.reference.key])}"
            take(results.failed(case, bench, reason))
    for line in spread(sized(rest), work):
        take(line)
    return {case.key: lines[case.key] for case in everything if case.key in lines}


def _run(bench: Bench, task: Sized) -> Line:
    case, detectable = task
    return run(case, bench, detectable)


def _failed(bench: Bench, task: Sized, reason: str) -> Line:
    return results.failed(task[0], bench, reason)


def _why(line: Line) -> str:
    """The reason why a reference case gives no minimum detectable effects."""
    errors = [each["error"] for each in line["methods"].values() if each["error"]]
    return line["reason"] or ("; ".join(errors) if errors else "the diagnosis gave no sizes")
