"""A finding in words: what it is, how large, why this and not its neighbours, and what would tell them apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diagnosis.candidates import Candidate
from diagnosis.screen import Score, Screen
from estimators.report import significant

if TYPE_CHECKING:
    from diagnosis.findings import Finding


def explain(finding: Finding, candidate: Candidate, score: Score, screened: Screen) -> str:
    """A paragraph of plain sentences."""
    effect = candidate.effect
    sizes = ", ".join(
        f"{name.removeprefix(f'{candidate.name}.')} = {_value(each.value, each.std, each.unit)}"
        for name, each in finding.parameters.items()
        if each.value is not None and each.std is not None
    )
    told = [f"{effect.name}: {effect.title} ({effect.equation})" + (f"; {sizes}" if sizes else "") + "."]
    told.append(effect.signature)
    first = candidate.amplitudes[0]
    told.append(
        f"This record would have shown {score.detectable:.2g} {_unit(candidate, first)} of {first.split('.')[-1]}; "
        f"chance explains it with a probability of {_probability(finding.p_value)}."
    )
    others = [name for name in finding.odds if name != finding.effect]
    if finding.tied_with:
        tied = ", ".join(finding.tied_with)
        told.append(f"Tied with {tied}: under this excitation they do almost the same. {effect.separated_by}")
    if others:
        nearest = max(others, key=lambda name: finding.odds[name])
        if nearest not in finding.tied_with:
            told.append(f"Its nearest neighbour, {nearest}, is {_odds(finding.odds[nearest])} times less likely.")
        closed = screened.similarity(finding.effect, nearest) ** 2
        told.append(
            f"{nearest} instead would close about {100.0 * closed:.0f} % of the gap: a falling error proves little."
        )
    if finding.held_out is not None:
        gain, std = finding.held_out.gain, finding.held_out.std
        told.append(f"On data that the fit had not seen the log likelihood rises by {gain:.3g} +-{std:.2g}.")
    else:
        told.append("No part of these data tells enough of it to be held against another: record once more.")
    return " ".join(told)


def _value(value: float, std: float, unit: str) -> str:
    decimals = significant(std)
    return f"{value:.{decimals}f} +-{std:.{decimals}f}" + ("" if unit == "1" else f" {unit}")


def _unit(candidate: Candidate, name: str) -> str:
    unit = next(p.unit for p in candidate.attached.parameters if p.name == name)
    return "" if unit == "1" else unit


def _probability(value: float) -> str:
    return f"less than {1e-6:g}" if value < 1e-6 else f"{value:.2g}"


def _odds(value: float) -> str:
    ratio = 1.0 / max(value, 1e-9)
    return "a million" if ratio > 1e6 else f"{ratio:.2g}" if ratio < 1000.0 else f"{ratio:.0f}"
