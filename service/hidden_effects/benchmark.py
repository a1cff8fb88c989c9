"""The whole benchmark: which cases are left, the reference ones first, every line to the file as it comes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from service.hidden_effects.cases import Case, references
from service.hidden_effects.results import trials as results
from service.hidden_effects.spread import Spread
from service.hidden_effects.trial import DETECTABLE, Bench, Line

Told = Callable[[int, int], None]
"""Told how many cases are done, and of how many."""


def benchmark(
    cases: Sequence[Case], bench: Bench, path: Path, spread: Spread, progress: Told = lambda done, total: None
) -> dict[str, Line]:
    """Run those of `cases` that the file at `path` does not hold, and return the lines of all of them.

    The clean records that say how small an effect can be seen come first; where one fails, so do the cases that need
    it. Raises ResultsError for a file of other conditions; whatever ends it, what is done is in the file.
    """
    lines = results.read(path) if path.exists() else {}
    results.check(path, lines, bench.conditions)
    asked = list(dict.fromkeys((*references(cases), *cases)))
    done = len(asked) - len(results.left(asked, bench, lines))
    progress(done, len(asked))

    def detectable(case: Case) -> Mapping[str, float]:
        return dict(lines.get(case.reference.key, {}).get(DETECTABLE, {}))

    def take(line: Line) -> None:
        nonlocal done
        results.append(path, line)
        lines[line["key"]] = line
        done += 1
        progress(done, len(asked))

    # A reference whose diagnosis failed is asked again, since nothing else can be without it.
    sized = {key: line for key, line in lines.items() if DETECTABLE in line}
    for line in spread(results.left(references(cases), bench, sized), bench, detectable):
        take(line)
    able = []
    for case in results.left(cases, bench, lines):
        if case == case.reference:
            continue  # has just been asked
        if DETECTABLE in lines.get(case.reference.key, {}):
            able.append(case)
        else:
            reason = f"the reference case failed: {_why(lines[case.reference.key])}"
            take(results.failed(case, bench, reason))
    for line in spread(able, bench, detectable):
        take(line)
    return {case.key: lines[case.key] for case in asked if case.key in lines}


def _why(line: Line) -> str:
    """Why a reference case says nothing of sizes."""
    errors = [told["error"] for told in line["methods"].values() if told["error"]]
    return line["reason"] or ("; ".join(errors) if errors else "the diagnosis gave no sizes")
