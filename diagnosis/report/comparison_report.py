"""A comparison as a page: every model's verdict on every recording, then the details recording by recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from upright.diagnosis.prediction.compare import Comparison
from upright.diagnosis.report import tables
from upright.diagnosis.report.names import file_name, shown, units
from upright.diagnosis.report.page import Figures, Provenance, compared_figures, render
from upright.diagnosis.report.sentences import disturbance_text


@dataclass(frozen=True, slots=True)
class Compared:
    """One recording, or several together, by the name of `recording`: the models on it, as the page shows them."""

    recording: str
    comparisons: Sequence[Comparison]
    figures: Figures

    @property
    def errors(self) -> list[tuple[str, list[tuple[str, str, str]]]]:
        return list(tables.errors(self.comparisons))

    @property
    def loop_errors(self) -> list[tuple[str, ...]]:
        return list(loop_errors(self.comparisons))

    @property
    def why_no_loop(self) -> list[tuple[str, str]]:
        return why_no_loop(self.comparisons)


def write_comparison(
    answers: Sequence[tuple[str, Sequence[Comparison]]],
    *,
    provenance: Provenance | None = None,
    progress: Callable[[str], None] | None = None,
) -> str:
    """The page as text: `answers` are the models by recording, whose name comes first."""
    parts = []
    for number, (recording, comparisons) in enumerate(answers):
        if progress is not None:
            progress(f"drawing: {file_name(recording)}")
        parts.append(Compared(recording, comparisons, compared_figures(comparisons, str(number) if number else "")))
    models = list(dict.fromkeys(each.name for _, comparisons in answers for each in comparisons))
    return render(
        "compare.html",
        models,
        provenance,
        parts=parts,
        verdicts=[verdict(part.recording, each) for part in parts for each in part.comparisons],
        headline=_headline([each for part in parts for each in part.comparisons], models),
        file_name=file_name,
    )


def _headline(comparisons: Sequence[Comparison], models: Sequence[str]) -> tuple[str, str]:
    """The verdict's kind, which names its colour, and the line."""
    fails = {name: any(each.name == name and not each.adequate for each in comparisons) for name in models}
    right = [name for name in models if not fails[name]]
    wrong = [name for name in models if fails[name]]
    if not wrong:
        return "adequate", f"{', '.join(right)}: adequate, to within the noise"
    if not right:
        return "missing_effect", f"{', '.join(wrong)}: not adequate"
    return "adequate", f"{', '.join(right)}: adequate; {', '.join(wrong)}: not"


def loop_errors(comparisons: Sequence[Comparison]) -> Iterator[tuple[str, ...]]:
    """By channel and model, simulated in the closed loop: fit in percent, RMS error with unit, RMS error over noise."""
    for channel in dict.fromkeys(name for each in comparisons for name in each.closed_loop.measured):
        for each in comparisons:
            loop = each.closed_loop
            if channel in loop.measured:
                factor, unit = shown(units(each.innovations.problem.model)[channel])
                error = f"{factor * loop.rmse(channel):.3g} {unit}"
                yield channel, each.name, f"{loop.fit_percent(channel):.2f} %", error, f"{loop.over_floor(channel):.3g}"


def why_no_loop(comparisons: Sequence[Comparison]) -> list[tuple[str, str]]:
    """Models without a simulation in the closed loop, those with the same reason together, and the reason."""
    because: dict[str, list[str]] = {}
    for each in comparisons:
        if each.closed_loop.reason:
            because.setdefault(each.closed_loop.reason, []).append(each.name)
    return [(", ".join(names), reason) for reason, names in because.items()]


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """One model on one recording; text."""

    recording: str
    model: str
    verdict: str
    ratio: str
    missing: str
    disturbance: str
    loop: str


def verdict(recording: str, comparison: Comparison) -> VerdictRow:
    """A comparison in short."""
    loop = comparison.closed_loop
    return VerdictRow(
        recording=file_name(recording),
        model=comparison.name,
        verdict="adequate" if comparison.adequate else "not adequate",
        ratio=f"{comparison.innovation_ratio:.3g}",
        missing=", ".join(f"{each.rms:.3g} {each.unit}" for each in comparison.views.forces),
        disturbance=disturbance_text(comparison.disturbance) or "-",
        loop=", ".join(f"{name} {loop.over_floor(name):.3g}" for name in loop.measured) or "-",
    )
