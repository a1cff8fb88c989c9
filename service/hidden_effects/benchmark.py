"""The whole benchmark: run the remaining cases, the reference cases first, and write every line to the file at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from upright.service.hidden_effects.cases import Case, references
from upright.service.hidden_effects.results import trials as results
from upright.service.hidden_effects.spread import Spread
from upright.service.hidden_effects.trial import DETECTABLE, Bench, Line

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

    def detectable(case: Case) -> Mapping[str, float]:
        return dict(lines.get(case.reference.key, {}).get(DETECTABLE, {}))

    def take(line: Line) -> None:
        nonlocal done
        results.append(path, line)
        lines[line["key"]] = line
        done += 1
        progress(done, len(everything))

    # A reference whose diagnosis failed is repeated, since the other cases depend on it.
    sized = {key: line for key, line in lines.items() if DETECTABLE in line}
    for line in spread(results.left(references(cases), bench, sized), bench, detectable):
        take(line)
    able = []
    for case in results.left(cases, bench, lines):
        if case == case.reference:
            continue  # has just been run
        if DETECTABLE in lines.get(case.reference.key, {}):
            able.append(case)
        else:
            reason = f"the reference case failed: {_why(lines[case.reference.key])}"
            take(results.failed(case, bench, reason))
    for line in spread(able, bench, detectable):
        take(line)
    return {case.key: lines[case.key] for case in everything if case.key in lines}


def _why(line: Line) -> str:
    """The reason why a reference case gives no minimum detectable effects."""
    errors = [each["error"] for each in line["methods"].values() if each["error"]]
    return line["reason"] or ("; ".join(errors) if errors else "the diagnosis gave no sizes")
